"""RESULTS.md, from the files of policy folders."""
