"""Where the estimator starts: at rest, or in motion with one camera or several."""
