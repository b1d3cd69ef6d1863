"""Other people's file formats: trajectories, IMU recordings and tables, in and out."""
