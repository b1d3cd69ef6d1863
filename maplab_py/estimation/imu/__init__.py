"""Inertial measurements between vertices: preintegration and prediction, batched over edges."""
