"""Resources of maps: images, clouds, depth and grids in files of their own."""
