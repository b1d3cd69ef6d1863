"""Fusion of depth maps into truncated signed distances, and the surface between them."""
