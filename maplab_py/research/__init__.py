"""Baselines and studies of the self-calibration; no part of the mapping console needs them.

Baselines of the literature: a Kalman filter that estimates motion and calibration jointly
(`joint_ekf`) and selection of segments by information gain (`information_gain`).

Studies on simulated sessions: `python -m maplab_py.research --help`.
"""
