"""Readers and writers of external formats: trajectories, IMU recordings, tables, meshes."""
