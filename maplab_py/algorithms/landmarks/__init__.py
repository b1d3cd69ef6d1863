"""Landmarks: triangulation, quality, tracks and invalid observations."""
