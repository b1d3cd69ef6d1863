"""The calibrated sensors of one device: an IMU, a camera rig, or both, with ids that follow from them."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3
from maplab_py.options import Options
from maplab_py.sensors import Camera, CameraRig, Extrinsics, Imu, SensorSet, sensor_set


@dataclasses.dataclass(frozen=True, eq=False)
class RecordedSensors:
    """The calibrated sensors of a device."""

    sensors: SensorSet
    rig_id: str  # empty when it is an IMU alone
    imu_id: str = ""  # empty when there is no IMU
    notes: tuple[
        str, ...
    ] = ()  # for the user: what of the calibration was not understood, or is odd

    @cached_property
    def imu(self) -> Imu | None:
        """The IMU, None when there is none."""
        return self.sensors.imu(self.imu_id) if self.imu_id else None

    @cached_property
    def rig(self) -> CameraRig:
        """The camera rig."""
        return self.sensors.camera_rig(self.rig_id)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras of the rig."""
        return self.rig.cameras

    @property
    def T_I_C(self) -> F64:
        """Poses (C, 7) of the cameras on the IMU, on the rig's body when there is no IMU."""
        return self.sensors.T_I_C(self.imu_id, self.rig_id) if self.imu_id else self.rig.T_B_C

    def with_cameras(self, cameras: tuple[Camera, ...], T_I_C: F64) -> RecordedSensors:
        """Return the same sensors with another calibration of the cameras, poses (C, 7) on the IMU."""
        T_I_B = self.sensors.T_I_S(self.imu_id, self.rig_id)
        T_B_C = se3.compose(se3.inverse(T_I_B), T_I_C)
        return self.with_sensor(dataclasses.replace(self.rig, cameras=cameras, T_B_C=T_B_C))

    def with_sensor(self, sensor: CameraRig | Imu) -> RecordedSensors:
        """Return the same sensors with another calibration of the rig or the IMU under its id."""
        known = {**self.sensors.sensors, sensor.id: sensor}
        return dataclasses.replace(self, sensors=dataclasses.replace(self.sensors, sensors=known))

    def renamed(self) -> RecordedSensors:
        """Return the same sensors under ids that follow from their calibration."""
        return make_device(self.cameras, self.T_I_C, self.imu, self.notes)


class DeviceOptions(Options, prefix="selected_"):
    """Choice of the sensors of the device from a sensors.yaml that has several of a kind."""

    ncamera_sensor_id: str = ""
    """Camera rig to use, if sensors.yaml has several: id or unambiguous prefix"""
    imu_sensor_id: str = ""
    """IMU to use, if sensors.yaml has several: id or unambiguous prefix"""

    def check_unused(self, source: str) -> None:
        """Check that nothing is chosen.

        Raises:
            UserError: A sensor is chosen; `source` says why there is no choice.
        """
        for flag, value in (
            ("selected_ncamera_sensor_id", self.ncamera_sensor_id),
            ("selected_imu_sensor_id", self.imu_sensor_id),
        ):
            if value:
                raise UserError(f"--{flag}={value} needs a sensors.yaml: {source}")


def make_device(
    cameras: Sequence[Camera], T_I_C: F64, imu: Imu | None, notes: Sequence[str] = ()
) -> RecordedSensors:
    """Return sensors whose ids follow from their parameters.

    So sessions that were recorded with the same calibration are merged as those of one device.

    Args:
        cameras: Cameras without ids; none = the device is an IMU alone.
        T_I_C: Poses (C, 7) on the IMU, without IMU on the first camera.
    """
    sensors: dict[str, sensor_set.Sensor] = {}
    rig_id, imu_id = "", ""
    if imu is not None:
        imu_id = _imu_id(imu)
        sensors[imu_id] = dataclasses.replace(imu, id=imu_id)
    if cameras:
        rig = _rig(cameras, T_I_C)
        rig_id, sensors[rig.id] = rig.id, rig
    mounts = {sensor: Extrinsics(imu_id or rig_id, se3.identity()) for sensor in sensors}
    return RecordedSensors(SensorSet(sensors, mounts), rig_id, imu_id, tuple(notes))


def _rig(cameras: Sequence[Camera], T_B_C: F64) -> CameraRig:
    named = [dataclasses.replace(camera, id=_camera_id(camera)) for camera in cameras]
    if len({camera.id for camera in named}) < len(named):  # equal parameters at other places
        named = [
            dataclasses.replace(camera, id=_digest(camera.id, str(row)))
            for row, camera in enumerate(named)
        ]
    content = [*(camera.id for camera in named), T_B_C.round(12).tobytes().hex()]
    return CameraRig(_digest("rig", *content), tuple(named), T_B_C)


def with_cameras(device: RecordedSensors, rows: tuple[int, ...]) -> RecordedSensors:
    """Return the device with some cameras of its rig (rows); () = all.

    Raises:
        MapError: There is no such camera.
    """
    rig = device.rig
    if not rows or rows == tuple(range(len(rig.cameras))):
        return device
    if max(rows) >= len(rig.cameras):
        raise MapError(
            f"--rovio_active_camera_indices: there is no camera {max(rows)}: the calibration has "
            f"{len(rig.cameras)}, counted from 0"
        )
    extra = tuple(rig.camera_extra[row] for row in rows) if rig.camera_extra else ()
    part = dataclasses.replace(
        rig,
        id=_digest(rig.id, *map(str, rows)),
        cameras=tuple(rig.cameras[row] for row in rows),
        T_B_C=rig.T_B_C[list(rows)],
        camera_extra=extra,
    )
    sensors = {part.id if key == rig.id else key: s for key, s in device.sensors.sensors.items()}
    sensors[part.id] = part
    mounts = {}
    for key, mount in device.sensors.extrinsics.items():
        base = part.id if mount.base_sensor_id == rig.id else mount.base_sensor_id
        moved = dataclasses.replace(mount, base_sensor_id=base)
        mounts[part.id if key == rig.id else key] = moved
    chosen = SensorSet(sensors, mounts, device.sensors.extra)
    return dataclasses.replace(device, sensors=chosen, rig_id=part.id)


def at_middle_rows(device: RecordedSensors) -> RecordedSensors:
    """Return the device with images whose times are those of their middle rows.

    The known lateness of the rows moves to the time offset: its mean over the cameras, so that images taken
    together stay partners.
    """
    cameras = device.cameras if device.rig_id else ()
    late_s = [float(c.delay_s(np.array([[0.0, 0.5 * c.height_px]]))[0]) for c in cameras]
    shift_ns = round(1e9 * np.mean(late_s)) if late_s else 0
    if not shift_ns:
        return device
    moved = [
        dataclasses.replace(
            camera,
            time_offset_ns=camera.time_offset_ns + shift_ns,
            image_delay_s=camera.image_delay_s - 1e-9 * shift_ns,
        )
        for camera in cameras
    ]
    note = (
        f"images count at the time of their middle row, {1e-6 * shift_ns:+.3f} ms by the calibration; "
        "--imu_to_camera_time_offset_ns is the offset of that row"
    )
    known = device.with_sensor(dataclasses.replace(device.rig, cameras=tuple(moved)))
    return dataclasses.replace(known, notes=(*device.notes, note))


def with_time_offset(device: RecordedSensors, offset_ns: int) -> RecordedSensors:
    """Return the device with another time offset of all cameras (t_imu = t_camera + offset)."""
    cameras = tuple(
        dataclasses.replace(camera, time_offset_ns=offset_ns) for camera in device.rig.cameras
    )
    return device.with_sensor(dataclasses.replace(device.rig, cameras=cameras))


def _camera_id(camera: Camera) -> str:
    size = f"{camera.width_px} {camera.height_px} {camera.time_offset_ns} {camera.topic}"
    if camera.line_delay_ns:
        size += f" {camera.line_delay_ns}"
    if camera.image_delay_s:
        size += f" {camera.image_delay_s:.12g} s"
    numbers = np.concatenate([camera.intrinsics, camera.distortion_parameters]).tobytes().hex()
    return _digest(camera.projection.value, camera.distortion.value, size, numbers)


def _imu_id(imu: Imu) -> str:
    numbers = [
        imu.acc_noise_density,
        imu.acc_bias_random_walk_noise_density,
        imu.gyro_noise_density,
        imu.gyro_bias_random_walk_noise_density,
    ]
    if imu.intrinsics is not None:
        for matrix in (imu.intrinsics.T_g, imu.intrinsics.T_a, imu.intrinsics.R_A_I):
            numbers += matrix.round(12).ravel().tolist()
    return _digest("imu", imu.topic, *map(repr, numbers))


def _digest(*parts: str) -> str:
    """Return 32 hexadecimal digits that follow from the parts."""
    return hashlib.blake2b("\n".join(parts).encode(), digest_size=16).hexdigest()
