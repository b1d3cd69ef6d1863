"""Keypoints without drift: each is aligned with the patch about it in the first image of its track.

Lucas-Kanade from image to image adds up the errors of all images: patches are compared without a change of
scale and shear, and a keypoint moves away from its point by a pixel in five seconds. Its landmark is
then triangulated at a wrong depth, whatever the number of observations. Comparison with the first image
under an affine warp (J. Shi, C. Tomasi, Good Features to Track, CVPR 1994) has an error that does not grow.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F32, F64, U8
from maplab_py.vision.tracking.patch_kernels import SIDE_PX, align_patches, sample_patches

_MIN_SIMILARITY = 0.8
"""Correlation of a patch and the image below which the image does not show it."""
_LARGEST_STEP_PX = 1.5
"""Farthest that a keypoint is moved from where Lucas-Kanade has put it."""
_LARGEST_STRETCH = 1.8
"""Change of scale, in any direction, from which on the latest image takes the place of the first one."""


@dataclasses.dataclass(frozen=True, eq=False)
class AlignedKeypoints:
    """K keypoints in an image, and what the next images are compared with."""

    uv: F64  # (K, 2)
    patch: F32  # (K, S, S)
    warp: F64  # (K, 2, 2) from offsets in the patch to offsets in the image


def align(image: U8, uv: F64, patch: F32, warp: F64) -> AlignedKeypoints:
    """Align keypoints with their patches.

    Where the image does not show a patch, the keypoint stays where it is; it is compared with this image
    from now on.

    Args:
        image: Image (H, W).
        uv: Keypoints (K, 2) in it, from Lucas-Kanade.
        patch: Their patches (K, S, S).
        warp: Expected warps (K, 2, 2).
    """
    aligned_uv, aligned_warp, similarity = uv.copy(), warp.copy(), np.empty(len(uv))
    align_patches(image, patch, aligned_uv, aligned_warp, similarity)
    with np.errstate(invalid="ignore"):  # of places that are no numbers
        step_px = np.linalg.norm(aligned_uv - uv, axis=1)
    is_finite = np.isfinite(step_px) & np.isfinite(aligned_warp).all(axis=(1, 2))
    shows = is_finite & (similarity >= _MIN_SIMILARITY) & (step_px <= _LARGEST_STEP_PX)
    aligned_uv[~shows], aligned_warp[~shows] = uv[~shows], np.eye(2)
    stretch = np.linalg.svd(aligned_warp, compute_uv=False)
    is_stretched = (stretch[:, 0] > _LARGEST_STRETCH) | (stretch[:, 1] < 1.0 / _LARGEST_STRETCH)
    is_new = ~shows | is_stretched
    patch = patch.copy()
    patch[is_new], aligned_warp[is_new] = patches(image, aligned_uv[is_new]), np.eye(2)
    return AlignedKeypoints(aligned_uv, patch, aligned_warp)


def patches(image: U8, uv: F64) -> F32:
    """Return the patches (K, S, S) about keypoints (K, 2) of an image (H, W)."""
    result = np.empty((len(uv), SIDE_PX, SIDE_PX), dtype=np.float32)
    sample_patches(image, uv, result)
    return result
