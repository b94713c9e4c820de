"""Ways to merge the features of several streams: one file each, and one table of them."""
