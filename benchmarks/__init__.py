"""Measurements: speed ratios, the live page in a real browser, the soak."""
