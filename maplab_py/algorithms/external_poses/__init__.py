"""Measurements of other programs and receivers: trajectories and satellite positions."""
