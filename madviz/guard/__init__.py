"""Notices a camera that fails, and leaves it out. Needs NumPy; no simulator and no torch."""
