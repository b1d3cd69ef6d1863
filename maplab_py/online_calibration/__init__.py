"""Self-calibration beside a running odometry.

`beside` observes a run and hands segments to a process of low priority (`process`), which evaluates
them, keeps the database of the device, and calibrates when it is due. `suggestions` says which motion
is missing.
"""
