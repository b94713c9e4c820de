"""Episodes as files: rerun, film, HTML, datasets for LeRobot."""
