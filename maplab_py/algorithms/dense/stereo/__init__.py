"""Depth of the stereo pairs of a rig, and its check by neighbouring vertices."""
