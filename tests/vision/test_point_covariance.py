"""Covariances of points from their rays."""

import numpy as np

from maplab_py.vision.point_covariance import covariance_by_rays


def test_a_point_at_the_camera_has_a_covariance() -> None:
    # a ray of 0.7 mm: its information would exceed that of the prior by more than doubles resolve
    to_point = np.array([[2.7768e-4, -4.7299e-4, -4.9381e-4]])
    covariance = covariance_by_rays(
        to_point, np.array([1.7e-3]), np.array([True]), np.zeros(1, np.int64), 1
    )[0]
    sigma_m = np.sqrt(np.linalg.eigvalsh(covariance))
    assert 90.0 < sigma_m[2] <= 100.1
    assert np.all(sigma_m[:2] < 1e-4)
