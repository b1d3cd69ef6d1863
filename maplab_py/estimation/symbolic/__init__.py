"""Residuals, each written once as a casadi expression on the manifold."""
