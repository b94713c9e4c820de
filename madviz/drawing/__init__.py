"""A frame as pixels, without a page: colours, mosaic, viewpoint."""
