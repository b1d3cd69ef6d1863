"""Localisation of the odometry in a map while a recording is read."""
