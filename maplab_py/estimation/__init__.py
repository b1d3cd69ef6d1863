"""Estimation: residuals, compiled kernels, IMU integration, solver and linear algebra."""
