"""Keyframing: which vertices are worth keeping."""
