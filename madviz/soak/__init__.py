"""Lets visitors come and go: whether a server grows, and visitors without a browser."""
