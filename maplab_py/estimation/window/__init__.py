"""Fixed-lag smoothing: the last keyframes and frames of a running odometry in one dense window."""
