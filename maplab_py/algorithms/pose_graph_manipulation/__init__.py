"""Manipulation of pose graphs: edge uncertainties, disturbed vertices, layout of missions."""
