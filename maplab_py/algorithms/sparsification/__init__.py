"""Sparsification: selection of the landmarks to keep."""
