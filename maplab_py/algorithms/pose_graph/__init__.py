"""Manipulation of pose graphs: uncertainties of edges, disturbed vertices, missions laid apart."""
