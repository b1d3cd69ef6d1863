"""Sparsification: which landmarks are worth keeping."""
