"""Exact distances of points from triangle meshes, and distance fields of grids."""
