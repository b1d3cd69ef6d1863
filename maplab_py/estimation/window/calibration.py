"""The calibration of the cameras as states of a window: changes from a reference.

Source of the states and of their priors' sizes: Geneva et al., OpenVINS: A Research Platform for
Visual-Inertial Estimation, ICRA 2020, which has no line delay.
"""

from __future__ import annotations

import dataclasses
from functools import cached_property

import numpy as np

from maplab_py.array_types import F64, I32, I64
from maplab_py.estimation.codegen.kernels import CAMERA_DELAY_COLUMN, CAMERA_INTRINSICS_COLUMN
from maplab_py.estimation.kernels.window_arguments import WindowCameras
from maplab_py.estimation.terms.cameras import Cameras
from maplab_py.estimation.window.states import WindowStates
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Camera
from maplab_py.sensors.camera import DISTORTION_NAMES, MIRROR_NAMES

_ROTATION, _NUMBERS = 3, ("position x", "position y", "position z")
_ANGLES = ("rotation x", "rotation y", "rotation z")


_SIGNIFICANT_SIGMAS = 3.0
_UNITS = {
    "position": (1e3, "mm"),
    "rotation": (180.0 / np.pi, "deg"),
    "image delay": (1e3, "ms"),
    "line delay": (1e6, "us"),
    " fu": (1.0, "px"),
    " fv": (1.0, "px"),
    " cu": (1.0, "px"),
    " cv": (1.0, "px"),
}


# Standard deviations of the numbers of a calibration before anything is seen.
_POSITION_M, _ROTATION_RAD = 0.02, 0.06
_DELAY_S, _READOUT_S = 0.01, 0.015
"""Of the delay of images, and of the time from their first row to the last."""
_FOCAL_SHARE, _CENTRE_PX, _DISTORTION, _MIRROR = 0.01, 5.0, 0.01, 0.01


@dataclasses.dataclass(frozen=True, eq=False)
class WindowCalibration:
    """Reference of C cameras, and the K numbers of them that are estimated, as changes from it.

    `columns` (C, D) has the state of each number of a camera: position and rotation, delay of the images,
    line delay, one of padding, intrinsics; -1 = it is known. Cameras share delay and line delay.
    """

    cameras: tuple[Camera, ...]
    T_I_C: F64  # (C, 7)
    columns: I64  # (C, D)
    mean: F64  # (K,) to begin with
    sigma: F64  # (K,) of it
    table: F64  # (C, 1 + widest) parameters of the reference, as kernels read them
    direction: float = 1.0  # of time; -1 = frames are read backwards

    @classmethod
    def of(
        cls, cameras: tuple[Camera, ...], T_I_C: F64, kinds: tuple[str, ...] = ()
    ) -> WindowCalibration:
        """Return the calibration of cameras with poses (C, 7), of which some kinds are estimated."""
        table = Cameras.of(cameras, T_I_C)
        width = CAMERA_INTRINSICS_COLUMN + table.parameters.shape[1] - 1
        columns = np.full((len(cameras), width), -1, dtype=np.int64)
        sigma: list[float] = []
        for row, camera in enumerate(cameras):
            of_row = _sigmas_of(camera, kinds, is_first=row == 0)
            places = np.array(list(of_row), dtype=np.int64)
            columns[row, places] = len(sigma) + np.arange(len(places))
            sigma += of_row.values()
            timing = slice(CAMERA_DELAY_COLUMN, CAMERA_DELAY_COLUMN + 2)
            columns[row, timing] = columns[0, timing]
        values = np.array(sigma, dtype=np.float64)
        poses = np.ascontiguousarray(T_I_C, dtype=np.float64)
        return cls(cameras, poses, columns, np.zeros(len(values)), values, table.parameters)

    def __len__(self) -> int:
        return len(self.sigma)

    @property
    def has_lateness(self) -> bool:
        """Whether rows of images may be of other times than their frames."""
        timing = self.columns[:, CAMERA_DELAY_COLUMN : CAMERA_DELAY_COLUMN + 2]
        return bool((timing >= 0).any()) or any(camera.is_moving for camera in self.cameras)

    def changes(self, values: F64) -> F64:
        """Return the changes (C, D) of all numbers of the cameras."""
        if not len(self):
            return np.zeros(self.columns.shape)
        return np.where(self.columns >= 0, values[self.columns], 0.0)

    def of_kernels(self, values: F64) -> WindowCameras:
        """Return the cameras with some values (K,) of the states."""
        return self._with(values) if len(self) else self._known

    @cached_property
    def _known(self) -> WindowCameras:
        return self._with(self.mean)

    def _with(self, values: F64) -> WindowCameras:
        changes = self.changes(values)
        turn = changes[:, _ROTATION : _ROTATION + 3]
        T_I_C, slope = self.T_I_C, np.tile(np.eye(3), (len(self.cameras), 1, 1))
        if len(self):
            turned = so3.multiply(T_I_C[:, :4], so3.exp(turn))
            T_I_C = se3.make(turned, T_I_C[:, 4:] + changes[:, :3])
            slope = np.ascontiguousarray(so3.right_jacobian(turn))
        known = [(camera.image_delay_s, 1e-9 * camera.line_delay_ns) for camera in self.cameras]
        timing = changes[:, CAMERA_DELAY_COLUMN : CAMERA_DELAY_COLUMN + 2] + np.array(known)
        timing *= self.direction
        parameters = self.table.copy()
        parameters[:, 1:] += changes[:, CAMERA_INTRINSICS_COLUMN:]
        return WindowCameras(
            np.ascontiguousarray(T_I_C),
            parameters,
            np.ascontiguousarray(timing),
            slope,
            self.columns,
        )

    def calibrated(self, values: F64, delay_s: float = 0.0) -> tuple[tuple[Camera, ...], F64]:
        """Return cameras and poses (C, 7) with some values (K,), of images whose frames are so late."""
        cameras_now = self.of_kernels(values)
        cameras = []
        for row, camera in enumerate(self.cameras):
            size, count = len(camera.intrinsics), len(camera.distortion_parameters)
            numbers = cameras_now.parameters[row, 1 : 1 + size + count]
            lateness_s = float(cameras_now.timing_s[row, 0]) - delay_s
            line_delay_ns = camera.line_delay_ns
            if self.columns[row, CAMERA_DELAY_COLUMN + 1] >= 0:
                line_delay_ns = round(1e9 * float(cameras_now.timing_s[row, 1]))
            cameras.append(
                dataclasses.replace(
                    camera,
                    intrinsics=numbers[:size].copy(),
                    distortion_parameters=numbers[size:].copy(),
                    image_delay_s=lateness_s,
                    line_delay_ns=line_delay_ns,
                )
            )
        return tuple(cameras), cameras_now.T_I_C

    def with_delay(self, delay_s: float) -> WindowCalibration:
        """Return the calibration that begins with a delay of the middle rows of images, if it is a state."""
        column, camera = self.columns[0, CAMERA_DELAY_COLUMN], self.cameras[0]
        if column < 0 or not delay_s:
            return self
        timing_s = self.of_kernels(self.mean).timing_s[0]
        mean = self.mean.copy()
        mean[column] += delay_s - float(timing_s @ [1.0, 0.5 * camera.height_px])
        return dataclasses.replace(self, mean=mean)

    def reversed_at(self, values: F64) -> WindowCalibration:
        """Return the calibration with some values (K,), all known, for frames read backwards."""
        return dataclasses.replace(WindowCalibration.of(*self.calibrated(values)), direction=-1.0)

    def lateness_s(self, camera: I32, uv_px: F64, delay_s: F64 | float, now: WindowCameras) -> F64:
        """Return how much later than their frames keypoints (N,) were seen; see `rays_at_frame`."""
        if not self.has_lateness:
            return np.zeros(len(camera))
        timing_s = now.timing_s[camera]
        return np.asarray(timing_s[:, 0] + timing_s[:, 1] * uv_px[:, 1] - delay_s)

    def rays_at_frame(
        self,
        camera: I32,
        uv_px: F64,
        delay_s: F64,
        rays_C: F64,
        now: WindowCameras,
        rate_I: F64,
    ) -> F64:
        """Return rays (N, 3) as their cameras would have seen them at the frame's time.

        Only the turn is considered.

        Args:
            camera: Rows (N,) of the cameras.
            uv_px: Pixels (N, 2).
            delay_s: Of the frames (N,).
            rays_C: As seen.
            now: The cameras.
            rate_I: Angular velocities (N, 3) of the body.
        """
        q_I_C = now.T_I_C[camera, :4]
        turn = so3.exp(self.lateness_s(camera, uv_px, delay_s, now)[:, None] * rate_I)
        return so3.rotate(so3.inverse(q_I_C), so3.rotate(turn, so3.rotate(q_I_C, rays_C)))

    def units(self) -> list[tuple[float, str]]:
        """Return the factor by which each of the states (K) is displayed, and its unit."""
        return [_unit_of(name) for name in self.names()]

    def names(self) -> list[str]:
        """Return the names (K,) of the states."""
        names = [""] * len(self)
        for row in range(len(self.cameras) - 1, -1, -1):
            projection, distortion = self.cameras[row].projection, self.cameras[row].distortion
            pinhole = ("fu", "fv", "cu", "cv")
            labels = [*_NUMBERS, *_ANGLES, "image delay", "line delay", ""]
            labels += [*MIRROR_NAMES[projection], *pinhole, *DISTORTION_NAMES[distortion]]
            for label, column in zip(labels, self.columns[row], strict=False):
                if column >= 0:
                    is_shared = label.endswith("delay")
                    names[column] = label if is_shared else f"camera {row} {label}"
        return names


def _unit_of(name: str) -> tuple[float, str]:
    """Return the factor by which a number is displayed, and its unit."""
    for word, unit in _UNITS.items():
        if word in name:
            return unit
    return 1.0, ""


def _sigmas_of(camera: Camera, kinds: tuple[str, ...], *, is_first: bool) -> dict[int, float]:
    """Return the standard deviation of each number of a camera that is estimated, by its column."""
    result: dict[int, float] = {}
    if "extrinsics" in kinds:
        result |= dict.fromkeys(range(3), _POSITION_M)
        result |= dict.fromkeys(range(3, 6), _ROTATION_RAD)
    if "time_offset" in kinds and is_first:
        result[CAMERA_DELAY_COLUMN] = _DELAY_S
    if "line_delay" in kinds and is_first:
        result[CAMERA_DELAY_COLUMN + 1] = _READOUT_S / camera.height_px
    if "intrinsics" in kinds:
        mirrors = len(camera.intrinsics) - 4
        of_all = [_MIRROR] * mirrors
        of_all += (_FOCAL_SHARE * np.abs(camera.intrinsics[-4:-2])).tolist()
        of_all += [_CENTRE_PX] * 2
        of_all += [_DISTORTION] * len(camera.distortion_parameters)
        first = CAMERA_INTRINSICS_COLUMN
        result |= {first + k: sigma for k, sigma in enumerate(of_all)}
    return result


@dataclasses.dataclass(frozen=True, eq=False)
class CalibrationEstimate:
    """Estimate of the calibration by a window."""

    calibration: WindowCalibration
    values: F64  # (K,) changes
    sigma: F64  # (K,)
    delay_s: float  # of the frames' times against the stamps of images

    @property
    def differs(self) -> tuple[int, ...]:
        """States whose change exceeds three standard deviations."""
        off = np.abs(self.values) > _SIGNIFICANT_SIGMAS * self.sigma
        return tuple(np.flatnonzero(off).tolist())

    def cameras(self) -> tuple[tuple[Camera, ...], F64]:
        """Return cameras and poses (C, 7), for vertices that have the times of the frames."""
        return self.calibration.calibrated(self.values, self.delay_s)

    def words(self) -> list[str]:
        """Return every change with its standard deviation, and whether it is significant."""
        names, units = self.calibration.names(), self.calibration.units()
        return [
            f"{name} {size * value:+.3g} +- {size * sigma:.2g} {unit}".rstrip()
            for name, (size, unit), value, sigma in zip(
                names, units, self.values, self.sigma, strict=True
            )
        ]


@dataclasses.dataclass(frozen=True, eq=False)
class FrameTimes:
    """Times of the images of F frames, and rates at which the body turned."""

    rate_I: F64  # (F, 3) angular velocity as measured [rad/s]
    delay_s: F64  # (F,) of the frames, see `WindowFrame`

    def twist(self, states: WindowStates) -> F64:
        """Return velocity and angular velocity in I, and the delays, as kernels read them (F, 7)."""
        v_I = so3.rotate(so3.inverse(states.T_M_I[:, :4]), states.motion[:, :3])
        rate = self.rate_I - states.gyro_bias
        return np.ascontiguousarray(np.concatenate([v_I, rate, self.delay_s[:, None]], axis=1))
