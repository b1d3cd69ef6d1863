"""Landmarks: triangulation, quality, tracks, and what is wrong with their observations."""
