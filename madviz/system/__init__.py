"""Files, processes and what is imported by name."""
