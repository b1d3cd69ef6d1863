"""Localisation: estimation of the pose of images in a map."""
