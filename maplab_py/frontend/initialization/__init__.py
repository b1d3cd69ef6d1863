"""Initialization of the estimator: at rest, or in motion with one camera or several."""
