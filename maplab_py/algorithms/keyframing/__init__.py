"""Keyframing: selection of the vertices to keep."""
