"""Measurements: ratios, the live page under a stop-watch, the soak."""
