"""Binary descriptors of given keypoints.

BRISK (S. Leutenegger, M. Chli, R. Siegwart, ICCV 2011) as OpenCV computes it: 64 bytes, turned to
the direction of the keypoint's gradients. C++ maplab computes another pattern of 48 bytes; the two do
not match each other. A map stores the size of every descriptor, and `lc` does not mix sizes.
"""

from operator import attrgetter
from typing import Any

import numpy as np

from maplab_py.array_types import F64, U8, Mask

DESCRIPTOR_BYTES = 64
_brisk: list[Any] = []


def describe(image: U8, uv_px: F64, scale: F64) -> tuple[U8, Mask]:
    """Describe keypoints of an image.

    Args:
        image: Grey values (H, W).
        uv_px: Keypoints (K, 2).
        scale: Diameters (K,) of what the descriptors see [px].

    Returns:
        Descriptors (K, 64), zero where there is none, and whether there is (K,): keypoints too
        near to the border of the image have none.
    """
    import cv2

    if not _brisk:  # the tables of its patterns take 20 ms
        library: Any = cv2
        _brisk.append(library.BRISK_create())
    count = len(uv_px)
    descriptors = np.zeros((count, DESCRIPTOR_BYTES), dtype=np.uint8)
    is_described = np.zeros(count, dtype=np.bool_)
    if not count:
        return descriptors, is_described
    columns = uv_px[:, 0].tolist(), uv_px[:, 1].tolist(), scale.tolist()
    none = [-1] * count
    keypoints = list(map(cv2.KeyPoint, *columns, none, none, none, range(count)))
    kept, values = _brisk[0].compute(np.ascontiguousarray(image), keypoints)
    rows = np.fromiter(map(attrgetter("class_id"), kept), dtype=np.int64, count=len(kept))
    if len(rows):
        descriptors[rows], is_described[rows] = values, True
    return descriptors, is_described
