"""Self-calibration on informative motion segments: select segments, keep them, calibrate on them."""
