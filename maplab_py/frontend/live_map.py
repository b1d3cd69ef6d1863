"""The map of a run while it goes on, for the viewer."""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import F64, I64, U8
from maplab_py.frontend.map_builder import MapBuilder
from maplab_py.frontend.odometry_update import OdometryUpdate
from maplab_py.geometry import se3
from maplab_py.vimap import LandmarkQuality, VIMap
from maplab_py.vimap.edits import add_landmarks

_LONG_TRACK = 20
"""Frames after which a track counts as long."""


class LiveLandmarks:
    """Landmarks of the smoother by track, those included that have left the window."""

    def __init__(self) -> None:
        """Start without landmarks."""
        self._places: dict[int, F64] = {}

    def __len__(self) -> int:
        return len(self._places)

    def update(self, track_id: I64, p_M: F64) -> None:
        """Take the landmarks (L,), (L, 3) of the present window."""
        self._places.update(zip(track_id.tolist(), p_M, strict=True))

    def clear(self) -> None:
        """Forget all: a new mission has another frame."""
        self._places.clear()

    @property
    def p_M(self) -> F64:
        """Places (L, 3)."""
        return np.array(list(self._places.values()), dtype=np.float64).reshape(-1, 3)


def live_map(builder: MapBuilder, landmarks: LiveLandmarks) -> VIMap:
    """Return the map so far, with the smoother's landmarks of its last mission.

    Raises:
        EstimationError: There are fewer than two vertices.
    """
    vi_map = builder.make_map()
    p_M = landmarks.p_M
    if not len(p_M):
        return vi_map
    root = int(vi_map.vertex_start[len(vi_map.missions) - 1])
    p_I = se3.transform(se3.inverse(vi_map.vertices.T_M_I[root]), p_M)
    none = np.zeros(0, dtype=np.int64)
    return add_landmarks(
        vi_map,
        vertex=np.full(len(p_M), root),
        p_I=p_I,
        keypoint_rows=none,
        keypoint_landmark=none,
        quality=LandmarkQuality.GOOD,
    )


def picture_of_tracks(update: OdometryUpdate) -> U8 | None:
    """Return the images of a frame set side by side (H, W, 3) with their keypoints; None without images.

    Keypoints are blue when they are new and green when they have been tracked for long.
    """
    if not update.images:
        return None
    import cv2

    pictures = []
    for image, tracks in zip(update.images, update.tracked.cameras, strict=True):
        picture = cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
        share = np.minimum(tracks.num_frames / _LONG_TRACK, 1.0)
        colours = np.stack([0 * share, 200 * share, 255 * (1 - share)], axis=1).round()
        for (u, v), colour in zip(tracks.uv_px.tolist(), colours.tolist(), strict=True):
            cv2.circle(picture, (round(u), round(v)), 3, colour, -1, cv2.LINE_AA)
        pictures.append(picture)
    height = max(len(picture) for picture in pictures)
    padded = [np.pad(p, ((0, height - len(p)), (0, 0), (0, 0))) for p in pictures]
    return np.concatenate(padded, axis=1)
