"""Baselines of the literature for the self-calibration, which the thesis compares with.

A Kalman filter that estimates motion and calibration jointly (`joint_ekf`), and selection of segments by
information gain (`information_gain`).
"""
