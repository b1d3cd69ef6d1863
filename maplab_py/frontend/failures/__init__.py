"""Sensors that fail while the odometry runs: found by images, samples and motion, and left out."""
