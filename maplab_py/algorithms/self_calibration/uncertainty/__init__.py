"""Uncertainty of a calibration, and the contribution of a segment to it."""
