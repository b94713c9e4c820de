"""Returned notebooks, run and checked: from a folder of copies to a table."""
