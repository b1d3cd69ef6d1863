"""Absolute and relative pose errors of trajectories."""
