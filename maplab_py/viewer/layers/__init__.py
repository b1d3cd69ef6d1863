"""Layers of the scene, one module per family; each builds plain arrays from a map."""
