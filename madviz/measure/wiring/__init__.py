"""Is it wired right? Changes of a wire file that people need, tried one at a time."""
