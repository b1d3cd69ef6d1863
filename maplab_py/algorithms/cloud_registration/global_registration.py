"""Registration of clouds without an initial pose.

Source: Lim et al., KISS-Matcher (ICRA 2025), the library kiss_matcher.
"""

from __future__ import annotations

import numpy as np

from maplab_py.algorithms.cloud_registration.libraries import kiss_matcher
from maplab_py.algorithms.cloud_registration.registration import PreparedCloud
from maplab_py.array_types import F64
from maplab_py.geometry import se3

_VOXEL_RATIO = 3.0
"""Voxels of the matcher relative to those of the cloud."""
_MIN_INLIERS = 5


def register_globally(
    target: PreparedCloud, source: PreparedCloud, voxel_size_m: float
) -> F64 | None:
    """Return the approximate pose (7,) of a source cloud in a target cloud, None if there is none.

    Raises:
        UserError: kiss_matcher is not installed.
    """
    library = kiss_matcher()
    matcher = library.KISSMatcher(library.KISSMatcherConfig(_VOXEL_RATIO * voxel_size_m))
    result = matcher.estimate(source.p_S.astype(np.float32), target.p_S.astype(np.float32))
    if matcher.get_num_final_inliers() < _MIN_INLIERS:
        return None
    matrix = np.eye(4)
    matrix[:3, :3] = np.asarray(result.rotation)
    matrix[:3, 3] = np.asarray(result.translation).reshape(3)
    return se3.from_matrix(matrix) if np.isfinite(matrix).all() else None
