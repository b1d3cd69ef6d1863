"""Keypoints of images: preparation of images, detection on a grid, binary descriptors."""
