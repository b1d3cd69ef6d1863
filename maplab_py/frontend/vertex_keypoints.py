"""Keypoints of a vertex: tracks with descriptors."""

import collections
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from maplab_py.array_types import U8, Mask
from maplab_py.frontend import odometry_update, recorded_mission
from maplab_py.interop.recordings.protocol import TrackedFrame
from maplab_py.vision.features import description, extractors, options
from maplab_py.vision.tracking.tracks import CameraTracks, TrackedImages

_BETWEEN = "brisk"
"""Descriptors of vertices between those that a network describes."""
_MOST_WAITING = 16
"""Vertices whose images are kept for the thread; then the odometry waits for the oldest."""


class VertexKeypoints:
    """Describes the keypoints of vertices in a thread beside the odometry."""

    def __init__(self, features: str, every: int) -> None:
        """Begin without vertices.

        Args:
            features: Name of the descriptors.
            every: A network describes every so many vertices, the others get binary descriptors.

        Raises:
            UserError: The network is not installed.
        """
        check_descriptors_exist(features)
        self._features, self._every, self._count = features, every, 0
        self._thread = ThreadPoolExecutor(1, "maplab-vertices")
        self._waiting: collections.deque[Future[tuple[TrackedFrame, ...]]] = collections.deque()

    def of(self, update: odometry_update.OdometryUpdate) -> recorded_mission.VertexFrames:
        """Return the keypoints of a frame that becomes a vertex; those of a replay as they are."""
        if update.tracks is not None:
            return update.tracks.frames
        is_turn, self._count = self._count % self._every == 0, self._count + 1
        features = self._features
        if features in options.NETWORKS and not is_turn:
            features = _BETWEEN
        if len(self._waiting) == _MOST_WAITING:
            self._waiting.popleft().result()
        self._waiting.append(
            self._thread.submit(
                described_frames, update.tracked, update.images, update.time_ns, features
            )
        )
        return self._waiting[-1]


def described_frames(
    tracked: TrackedImages, images: tuple[U8, ...], stamp_ns: int, descriptor_type: str = ""
) -> tuple[TrackedFrame, ...]:
    """Return the tracks of each camera with the descriptors of their image patches.

    Keypoints so near to the border that they have no descriptor are left out.

    Args:
        tracked: Tracks of all cameras.
        images: Images of all cameras.
        stamp_ns: Time of the images.
        descriptor_type: Name of the descriptors; empty = those that the tracks are to get.

    Raises:
        UserError: The descriptors are those of a network that is not installed.
    """
    return tuple(
        _described(row, tracks, image, stamp_ns, descriptor_type or tracked.descriptor_type)
        for row, (tracks, image) in enumerate(zip(tracked.cameras, images, strict=True))
    )


def check_descriptors_exist(descriptor_type: str) -> None:
    """Check, before a run, that keypoints can be described.

    Raises:
        UserError: The descriptors are those of a network that is not installed.
    """
    if descriptor_type == "xfeat":
        from maplab_py.vision.features.learned.xfeat import installed_xfeat

        installed_xfeat()


def _described(
    camera: int, tracks: CameraTracks, image: U8, stamp_ns: int, descriptor_type: str
) -> TrackedFrame:
    kind = extractors.KINDS[descriptor_type]
    if descriptor_type == "xfeat":
        from maplab_py.vision.features.learned.xfeat import installed_xfeat

        descriptors: U8 = installed_xfeat().describe(image, tracks.uv_px).view(np.uint8)
        is_described: Mask = np.ones(len(tracks), dtype=np.bool_)
    else:
        descriptors, is_described = description.describe(image, tracks.uv_px, tracks.scale)
    kept = tracks.take(is_described)
    return TrackedFrame(
        camera=camera,
        stamp_ns=stamp_ns,
        uv_px=kept.uv_px,
        sigma_px=kept.sigma_px,
        scale=kept.scale,
        track_id=kept.track_id.astype(np.int32),
        descriptor=descriptors[is_described],
        descriptor_size=np.full(len(kept), kind.size, dtype=np.int32),
        feature_type=kind.feature_type,
        depth=kind.depth,
    )
