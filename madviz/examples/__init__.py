"""Policies and tasks that are not madviz's, to start your own from."""
