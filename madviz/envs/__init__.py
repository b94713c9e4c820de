"""Environments: one contract (``base``), Meta-World on MuJoCo, and a toy drawn with NumPy."""
