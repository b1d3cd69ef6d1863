"""Keypoints of a frame that are matched with a map."""

from collections.abc import Sequence

import numpy as np

from maplab_py.algorithms.landmarks.keypoint_rays import bearings
from maplab_py.algorithms.localization.localizer import Query
from maplab_py.array_types import F64, I32, I64, U8, Mask, Rows
from maplab_py.frontend.odometry_update import OdometryUpdate
from maplab_py.frontend.vertex_keypoints import described_frames
from maplab_py.geometry import so3
from maplab_py.interop.recordings.protocol import RecordedSensors, TrackedFrame
from maplab_py.vimap.descriptors import FeatureType


class FrameKeypoints(Rows):
    """N keypoints with descriptors of all cameras of one frame."""

    time_ns: int
    feature_type: int
    track_id: I64  # (N,) -1 = on no track
    camera: I32  # (N,)
    descriptors: U8  # (N, bytes)
    origin_I: F64  # (N, 3) camera centres in the body frame [m]
    ray_I: F64  # (N, 3) unit rays in the body frame
    rad_per_px: F64  # (N,) angle that a pixel covers

    def query(self, q_M_I: F64) -> Query:
        """Return the query of all keypoints, with the attitude (4,) of the body."""
        return Query(
            key=(self.time_ns // 1000) % (1 << 40),
            descriptors=self.descriptors,
            origin_I=self.origin_I,
            ray_I=self.ray_I,
            rad_per_px=self.rad_per_px,
            q_M_I=q_M_I,
        )


def frame_keypoints(
    update: OdometryUpdate, device: RecordedSensors, descriptor_type: str = ""
) -> FrameKeypoints:
    """Return the keypoints of a frame with descriptors of the most frequent size.

    Images are described here, keypoints of a replay have their descriptors.

    Args:
        update: The frame.
        device: Its sensors.
        descriptor_type: Name of the descriptors of images; empty = those that the tracks are to get.
    """
    if update.tracks is not None:
        frames: Sequence[TrackedFrame | None] = update.tracks.frames
    elif update.images:
        frames = described_frames(update.tracked, update.images, update.time_ns, descriptor_type)
    else:
        frames = ()
    given = [frame for frame in frames if frame is not None]
    by_size = np.bincount(np.concatenate([[0], *(f.descriptor_size for f in given)]).astype(int))
    by_size[0] = 0
    size = int(np.argmax(by_size))
    parts = [_of_camera(frame, device, size) for frame in given]
    parts = parts or [_nothing(size)]
    columns = (np.concatenate(column) for column in zip(*parts, strict=True))
    feature_type = given[0].feature_type if given else FeatureType.BINARY
    return FrameKeypoints(update.time_ns, feature_type, *columns)


_Columns = tuple[I64, I32, U8, F64, F64, F64]


def _of_camera(frame: TrackedFrame, device: RecordedSensors, size: int) -> _Columns:
    ray_C, rad_per_px, is_ray = bearings(device.cameras[frame.camera], frame.uv_px)
    kept: Mask = is_ray & (frame.descriptor_size == size) & (size > 0)
    T_I_C = device.T_I_C[frame.camera]
    count = int(np.count_nonzero(kept))
    return (
        frame.track_id[kept].astype(np.int64),
        np.full(count, frame.camera, dtype=np.int32),
        np.ascontiguousarray(frame.descriptor[kept, :size]),
        np.tile(T_I_C[4:], (count, 1)),
        so3.rotate(T_I_C[:4], ray_C[kept]),
        rad_per_px[kept],
    )


def _nothing(size: int) -> _Columns:
    zeros = np.zeros((0, 3))
    ids, camera = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int32)
    return ids, camera, np.zeros((0, size), dtype=np.uint8), zeros, zeros, np.zeros(0)
