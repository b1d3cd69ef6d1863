"""Detectors with descriptors by name: SIFT, ORB, BRISK and AKAZE of OpenCV, and the network XFeat.

SIFT descriptors (D. Lowe, IJCV 2004) are the square roots of their shares of the sum, 512 units long
(R. Arandjelovic, A. Zisserman, CVPR 2012), as COLMAP stores them, so that the two match each other.
"""

import threading
from typing import Any

import numpy as np

from maplab_py.array_types import F64, U8
from maplab_py.vimap.descriptors import DescriptorDepth, FeatureType
from maplab_py.vision.descriptors import DescriptorKind
from maplab_py.vision.features.extension import ExtractedFeatures

KINDS = {
    "sift": DescriptorKind(128, FeatureType.SIFT),
    "orb": DescriptorKind(32),
    "brisk": DescriptorKind(64),
    "akaze": DescriptorKind(61),
    "xfeat": DescriptorKind(256, FeatureType.XFEAT, DescriptorDepth.FLOAT32),
}
"""Descriptors of each extractor."""
_SIFT_LENGTH = 512.0
_local = threading.local()


def extract(name: str, image: U8, max_features: int) -> ExtractedFeatures:
    """Return the strongest features of an image, the strongest first; deterministic.

    Threads may call it at the same time.

    Args:
        name: One of `KINDS`.
        image: Grey values (H, W).
        max_features: Largest number of features.

    Raises:
        UserError: It is a network that is not installed.
    """
    if name == "xfeat":
        from maplab_py.vision.features.learned.xfeat import installed_xfeat

        return installed_xfeat().extract(image, max_features)
    keypoints, descriptors = _detector(name, max_features).detectAndCompute(
        np.ascontiguousarray(image), None
    )
    rows = np.array(
        [(*point.pt, point.size, point.response, point.angle) for point in keypoints]
    ).reshape(-1, 5)
    size = KINDS[name].size
    if descriptors is None:
        descriptors = np.zeros((0, size), dtype=np.uint8)
    elif name == "sift":
        total = descriptors.sum(axis=1, keepdims=True)  # bytes of square roots, 512 long
        roots = np.sqrt(np.maximum(descriptors, 0.0) / np.maximum(total, 1e-9))
        descriptors = np.asarray(np.clip(np.rint(_SIFT_LENGTH * roots), 0, 255), dtype=np.uint8)
    # ties are decided by place and direction, not by the order in which threads found them
    order = np.lexsort((rows[:, 4], rows[:, 0], rows[:, 1], -rows[:, 3]))[:max_features]
    uv_px: F64 = rows[order, :2]
    return ExtractedFeatures(uv_px, rows[order, 3], descriptors[order], rows[order, 2])


def _detector(name: str, max_features: int) -> Any:
    """Return this thread's detector; those of BRISK and AKAZE do not take a number of features."""
    detectors = _local.__dict__
    key = f"{name} {max_features}"
    if key not in detectors:
        import cv2

        library: Any = cv2
        if name == "sift":
            # precise upscaling: else keypoints of the finest octave are off by a quarter pixel
            detectors[key] = library.SIFT_create(
                nfeatures=max_features, enable_precise_upscale=True
            )
        elif name == "orb":
            detectors[key] = library.ORB_create(nfeatures=max_features)
        else:
            detectors[key] = getattr(library, f"{name.upper()}_create")()
    return detectors[key]
