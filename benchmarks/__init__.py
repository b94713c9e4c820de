"""Benchmarks: speed ratios, the live page in a real browser, what features and pictures hold."""
