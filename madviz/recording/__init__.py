"""Episodes as files: rerun, film, HTML."""
