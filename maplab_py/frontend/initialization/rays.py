"""The observations of a segment as rays in the frame of the IMU."""

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I32, I64
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.frontend.initialization.segment import Segment
from maplab_py.geometry import so3
from maplab_py.sensors import Camera
from maplab_py.vision.tracking import ray_table, views


@dataclasses.dataclass(frozen=True, eq=False)
class SegmentRays:
    """N rays, those of the same track next to each other, in the order of time."""

    frame: I32  # (N,)
    camera: I32  # (N,)
    track: I64  # (N,) consecutive numbers, ascending
    track_id: I64  # (N,)
    ray_I: F64  # (N, 3) unit
    p_I_C: F64  # (N, 3) where they begin
    sigma: F64  # (N,) [rad]

    @property
    def start(self) -> I64:
        """Offsets (T + 1,) of the tracks."""
        count = int(self.track[-1]) + 1 if len(self.track) else 0
        return np.searchsorted(self.track, np.arange(count + 1)).astype(np.int64)


class RayMaker:
    """Makes rays of the pixels of a rig."""

    def __init__(self, cameras: tuple[Camera, ...], T_I_C: F64) -> None:
        """Prepare for cameras with poses (C, 7) on the IMU."""
        self._tables = [ray_table.RayTable.of(camera) for camera in cameras]
        self._R_I_C, self._p_I_C = so3.to_matrix(T_I_C[:, :4]), T_I_C[:, 4:]
        self._focal_px = np.array([views.focal_length_px(camera) for camera in cameras])
        self._line_s = np.array([1e-9 * camera.line_delay_ns for camera in cameras])
        self._middle_px = np.array([0.5 * camera.height_px for camera in cameras])

    def of(self, segment: Segment) -> SegmentRays:
        """Return the rays of a segment; pixels without rays are left out.

        Those of other rows are turned to where they would be if they were read with the middle row.
        """
        ray_C, exists = np.zeros((len(segment.frame), 3)), np.zeros(len(segment.frame), dtype=bool)
        for camera, table in enumerate(self._tables):
            rows = np.flatnonzero(segment.camera == camera)
            ray_C[rows], exists[rows] = table.rays(segment.uv_px[rows])
        order = np.lexsort((segment.camera, segment.frame, segment.track_id))
        order = order[exists[order]]
        camera_of = segment.camera[order]
        ray_I = (self._R_I_C[camera_of] @ ray_C[order][:, :, None])[:, :, 0]
        if self._line_s.any():
            rows_px = segment.uv_px[order, 1] - self._middle_px[camera_of]
            rate_I = angular_velocity(segment.inertial, np.zeros(3))[segment.frame[order]]
            ray_I = so3.rotate(
                so3.exp((self._line_s[camera_of] * rows_px)[:, None] * rate_I), ray_I
            )
        _, track = np.unique(segment.track_id[order], return_inverse=True)
        return SegmentRays(
            frame=segment.frame[order],
            camera=camera_of,
            track=np.asarray(track, dtype=np.int64).reshape(-1),
            track_id=segment.track_id[order],
            ray_I=ray_I,
            p_I_C=self._p_I_C[camera_of],
            sigma=segment.sigma_px[order] / self._focal_px[camera_of],
        )


def angular_velocity(inertial: InertialData, gyro_bias: F64) -> F64:
    """Return the angular velocity (F, 3) [rad/s] at the frames, with which edges begin and end."""
    rows = np.append(inertial.sample_start[:-1], inertial.sample_start[-1] - 1)
    T_g_inverse = inertial.corrections[0][0]
    return np.asarray((inertial.accel_gyro[rows, 3:] - gyro_bias) @ T_g_inverse.T)
