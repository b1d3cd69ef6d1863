"""The map of a run while it goes on, for the viewer."""

import numpy as np

from maplab_py.array_types import F64, I64, U8
from maplab_py.frontend.localization.online import LocalizedFrame
from maplab_py.frontend.map_builder import MapBuilder
from maplab_py.frontend.odometry_update import OdometryUpdate
from maplab_py.geometry import se3
from maplab_py.vimap import LandmarkQuality, VIMap, edits

_LONG_TRACK = 20
"""Frames after which a track counts as long."""


class LiveLandmarks:
    """Landmarks of the smoother by track, those included that have left the window."""

    def __init__(self) -> None:
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


class LiveLocalization:
    """The path in a map in which the run is localised, and the latest matches."""

    def __init__(self) -> None:
        self.T_G_M: F64 | None = None  # as it was estimated last
        self._path: list[F64] = []
        self.rays_G: F64 = np.zeros(
            (0, 2, 3)
        )  # from the body to the landmarks of the latest matches

    def add(self, frame: LocalizedFrame, p_G: F64) -> None:
        """Take a frame that is localised in a map with landmarks (L, 3)."""
        if frame.pose is None:
            return
        self.T_G_M = frame.pose.T_G_M
        position = frame.pose.T_G_I[4:]
        self._path.append(position)
        if frame.answer is not None:
            seen = p_G[frame.answer.landmark]
            self.rays_G = np.stack([np.broadcast_to(position, seen.shape), seen], axis=1)

    def clear(self) -> None:
        """Forget T_G_M: a new mission has another frame M. The path in the map stays."""
        self.T_G_M, self.rays_G = None, np.zeros((0, 2, 3))
        if self._path:
            self._path.append(np.full(3, np.nan))

    @property
    def p_G_I(self) -> F64:
        """Positions (N, 3) as estimated at their time; not numbers between two missions."""
        return np.array(self._path).reshape(-1, 3)


def live_map(builder: MapBuilder, landmarks: LiveLandmarks, T_G_M: F64 | None = None) -> VIMap:
    """Return the map so far, with the smoother's landmarks of its last mission.

    Args:
        builder: Of the map.
        landmarks: Of the smoother.
        T_G_M: Where the last mission (7,) lies in the map in which it is localised; None = unknown.

    Raises:
        EstimationError: There are fewer than two vertices.
    """
    vi_map = builder.make_map()
    if T_G_M is not None:
        frames, row = vi_map.baseframes, int(vi_map.missions.baseframe[-1])
        vi_map = vi_map.replace(baseframes=frames.put(row, T_G_M=T_G_M))
    p_M = landmarks.p_M
    if not len(p_M):
        return vi_map
    root = int(vi_map.vertex_start[len(vi_map.missions) - 1])
    p_I = se3.transform(se3.inverse(vi_map.vertices.T_M_I[root]), p_M)
    none = np.zeros(0, dtype=np.int64)
    return edits.add_landmarks(
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
