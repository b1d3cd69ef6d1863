"""Dense maps: depth of stereo images, fusion into one surface, meshes."""
