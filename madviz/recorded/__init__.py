"""Recordings of a robot of one's own: LeRobot datasets, read and cached."""
