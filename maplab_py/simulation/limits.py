"""Which values a scenario may have."""

from __future__ import annotations

import math
from typing import Any

from maplab_py.errors import UserError
from maplab_py.sensors import Distortion, Projection
from maplab_py.sensors.camera import DISTORTION_SIZE, INTRINSICS_SIZE
from maplab_py.simulation.scenario import MOTION_KINDS, CameraOptions, MotionOptions, Scenario

_POSITIVE = (
    "world.rooms",
    "world.landmarks_per_room",
    "imu.rate_hz",
    "imu.gravity_mps2",
    "measurement.frame_rate_hz",
    "measurement.max_keypoints",
    "measurement.max_distance_m",
    "appearance.descriptor_bytes",
    "appearance.latent_dimensions",
)
_PROBABILITIES = (
    "world.patchiness",
    "measurement.detection_probability",
    "measurement.track_break_probability",
    "measurement.identity_swap_share",
    "measurement.clutter_share",
    "appearance.vanish_share",
)
_NOT_NEGATIVE = (
    "seeds.world",
    "seeds.motion",
    "seeds.measurement",
    "seeds.appearance",
    "world.furniture_per_room",
    "imu.gyro_noise_density",
    "imu.accel_noise_density",
    "imu.gyro_bias_walk",
    "imu.accel_bias_walk",
    "measurement.keypoint_sigma_px",
    "measurement.min_distance_m",
    "drift.position_walk",
    "drift.yaw_walk_deg",
    "drift.scale_sigma",
)


def check_scenario(scenario: Scenario) -> None:
    """Check the values of a scenario.

    Raises:
        UserError: A value is out of its range; names the key.
    """
    for keys, low, high, text in (
        (_POSITIVE, math.nextafter(0.0, 1.0), math.inf, "greater than 0"),
        (_NOT_NEGATIVE, 0.0, math.inf, "0 or greater"),
        (_PROBABILITIES, 0.0, 1.0, "between 0 and 1"),
    ):
        for key in keys:
            value = _value(scenario, key)
            if not (math.isfinite(value) and low <= value <= high):
                raise UserError(f"{key}: must be {text}, not {value:g}")
    if scenario.measurement.clutter_share > 0.9:
        raise UserError("measurement.clutter_share: must not exceed 0.9")
    if min(scenario.world.room_size_m) <= 0.0:
        raise UserError("world.room_size_m: must be greater than 0")
    if scenario.measurement.frame_rate_hz > scenario.imu.rate_hz:
        raise UserError("measurement.frame_rate_hz: must not exceed imu.rate_hz")
    if not scenario.sessions:
        raise UserError("sessions: at least one is needed")
    if not scenario.cameras:
        raise UserError("cameras: at least one is needed")
    for row, session in enumerate(scenario.sessions):
        _check_session(scenario, session, f"sessions[{row}]")
    for row, camera in enumerate(scenario.cameras):
        _check_camera(camera, f"cameras[{row}]")


def _value(scenario: Scenario, key: str) -> Any:
    value: Any = scenario
    for part in key.split("."):
        value = getattr(value, part)
    return value


def _check_session(scenario: Scenario, session: MotionOptions, key: str) -> None:
    if session.kind not in MOTION_KINDS:
        known = ", ".join(MOTION_KINDS)
        raise UserError(f"{key}.kind: must be one of {known}, not '{session.kind}'")
    frames = session.duration_s * scenario.measurement.frame_rate_hz
    if not frames >= 2.0:
        raise UserError(f"{key}.duration_s: too short for two frames")
    if session.turns == 0.0:
        raise UserError(f"{key}.turns: must not be 0")
    size = scenario.world.room_size_m
    if not 0.0 < session.wall_distance_m < 0.5 * min(size[:2]):
        raise UserError(f"{key}.wall_distance_m: leaves no room to move in")
    swing = abs(session.height_swing_m) + session.shake_m
    if not swing < session.height_m < size[2] - swing:
        raise UserError(f"{key}.height_m: leads through floor or ceiling")


def _check_camera(camera: CameraOptions, key: str) -> None:
    for name, kinds in (("projection", Projection), ("distortion", Distortion)):
        known = [member.value for member in kinds]
        if getattr(camera, name) not in known:
            raise UserError(
                f"{key}.{name}: must be one of {', '.join(known)}, not '{getattr(camera, name)}'"
            )
    sizes = (
        ("intrinsics", INTRINSICS_SIZE[Projection(camera.projection)]),
        ("distortion_parameters", DISTORTION_SIZE[Distortion(camera.distortion)]),
    )
    for name, size in sizes:
        if len(getattr(camera, name)) != size:
            raise UserError(
                f"{key}.{name}: {size} values are wanted, not {len(getattr(camera, name))}"
            )
    if min(camera.width_px, camera.height_px) < 16:
        raise UserError(f"{key}.width_px, height_px: the image is too small")
