"""Simulation of visual-inertial sessions with ground truth."""
