"""Policy folders: configuration, weights, card."""
