"""Sparse linear algebra: block Cholesky factorisation of the reduced normal equations."""
