"""Recordings of all sensors of a session."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64, I64, NDArray
from maplab_py.errors import MapError, UserError
from maplab_py.interop.imu_csv import read_imu_csv
from maplab_py.simulation import detection, scene, sensors, trajectory_motion
from maplab_py.simulation.imu import ImuRecording, measure
from maplab_py.simulation.motion import check_free_way, motion_spline
from maplab_py.simulation.scenario import Scenario, SessionOptions
from maplab_py.simulation.spline import MotionState, PoseSpline
from maplab_py.simulation.world import World

_EPOCH_NS = 1_600_000_000_000_000_000
_SESSION_GAP_NS = 3_600_000_000_000


@dataclasses.dataclass(frozen=True, eq=False)
class SessionSeeds:
    """Random generators, one per source of randomness."""

    motion: np.random.Generator
    measurement: np.random.Generator
    appearance: np.random.Generator
    other: np.random.Generator
    ids: np.random.Generator


@dataclasses.dataclass(frozen=True, eq=False)
class Recording:
    """All recorded data, at the V vertices unless stated otherwise."""

    time_ns: I64  # (V,)
    motion: MotionState
    states: sensors.DriftedStates
    imu_time_ns: I64  # (S,) of all samples
    imu_motion: MotionState  # at all samples
    imu: ImuRecording  # of all samples
    imu_row: I64  # (V,) sample at the vertex
    keypoints: detection.Detections  # of all cameras; `frame` counts vertex * cameras + camera
    descriptors: NDArray[np.uint8]
    spline: PoseSpline  # the true motion
    frame_s: F64  # (V,) time of the images on the spline


def record(
    scenario: Scenario,
    number: int,
    world: World,
    device: sensors.Device,
    appearance: scene.SessionAppearance,
    seeds: SessionSeeds,
    spline: PoseSpline | None = None,
) -> Recording:
    """Move the device through the world and record its measurements.

    Args:
        number: Which of its sessions.
        appearance: Appearance of the world in this session.
        spline: The motion; None = that of the session's options.

    Raises:
        UserError: The motion leads out of the world or through a wall.
    """
    options = scenario.sessions[number]
    if spline is None:
        together = tuple(s for s in scenario.sessions if s.keep_frame) if options.keep_frame else ()
        spline = motion_spline(options, scenario.world, seeds.motion, together)
    check_free_way(spline, world, f"sessions[{number}]")
    readout = max(abs(c.line_delay_s) * c.height_px for c in scenario.cameras)
    lead_s = max(abs(scenario.imu.time_offset_s), readout)
    samples = recorded_samples(options, lead_s)
    if samples is None:
        clock = _Clock.of(scenario, options.total_s, lead_s)
        felt = spline.evaluate(clock.sample_s + clock.lead_s - scenario.imu.time_offset_s)
        imu = measure(scenario.imu, device.true_imu, felt, seeds.measurement)
    else:
        clock, imu = _Clock.of_samples(scenario, samples.time_s, lead_s), samples.imu
    imu_motion = spline.evaluate(clock.sample_s + clock.lead_s)
    motion = spline.evaluate(clock.sample_s[clock.frame_row] + clock.lead_s)
    states = sensors.drift(
        scenario.drift, motion, clock.sample_s[clock.frame_row], seeds.measurement
    )
    detections = _detect_all(scenario, world, device, spline, clock, appearance, seeds)
    kept, stamp_ns = _stamps(scenario, clock, seeds.other)
    gap_ns = round(scenario.changes.days_between_sessions * 86_400e9) or _SESSION_GAP_NS
    begin_ns = _EPOCH_NS + number * gap_ns
    return Recording(
        begin_ns + stamp_ns[clock.frame_row],
        motion,
        states,
        begin_ns + stamp_ns[kept],
        imu_motion.take(kept),
        imu.take(kept),
        np.searchsorted(kept, clock.frame_row),
        detections,
        scene.describe(appearance, detections, seeds.appearance),
        spline,
        clock.sample_s[clock.frame_row] + clock.lead_s,
    )


@dataclasses.dataclass(frozen=True, eq=False)
class _Clock:
    """Times of samples and images, counted from the session's begin."""

    sample_s: F64  # (S,)
    frame_row: I64  # (V,) sample at each image
    lead_s: float  # motion before the begin, for what is measured late

    @classmethod
    def of(cls, scenario: Scenario, seconds: float, lead: float) -> _Clock:
        rate, frame_rate = scenario.imu.rate_hz, scenario.measurement.frame_rate_hz
        samples = int(np.floor((seconds - 2.0 * lead) * rate + 1e-6)) + 1
        frames = int(np.floor((seconds - 2.0 * lead) * frame_rate + 1e-6)) + 1
        row = np.unique(np.minimum(np.round(np.arange(frames) * rate / frame_rate), samples - 1))
        return cls(np.arange(samples) / rate, row.astype(np.int64), lead)

    @classmethod
    def of_samples(cls, scenario: Scenario, time_s: F64, lead: float) -> _Clock:
        """Take images at those of the recorded samples (S,) that are nearest to the frame rate."""
        frame_rate = scenario.measurement.frame_rate_hz
        frames = int(np.floor((time_s[-1] - time_s[0]) * frame_rate + 1e-6)) + 1
        wanted = time_s[0] + np.arange(frames) / frame_rate
        middle = 0.5 * (time_s[1:] + time_s[:-1])
        row = np.unique(np.searchsorted(middle, wanted))
        return cls(time_s - lead, row.astype(np.int64), lead)


def _stamps(scenario: Scenario, clock: _Clock, rng: np.random.Generator) -> tuple[I64, I64]:
    """Return the samples (S',) that are not lost, and the time stamps (S,) [ns] of all.

    Those at the images are neither lost nor stamped wrongly: a map has one at each vertex.
    """
    options = scenario.imu
    count = len(clock.sample_s)
    stamp_ns = np.round(clock.sample_s * 1e9).astype(np.int64)
    is_kept = np.ones(count, dtype=np.bool_)
    if options.dropped_share > 0.0:
        is_kept = rng.uniform(size=count) >= options.dropped_share
    if options.time_jitter_s > 0.0:
        jitter = np.clip(rng.standard_normal(count), -3.0, 3.0) * options.time_jitter_s * 1e9
        jitter[clock.frame_row] = 0.0
        stamp_ns = stamp_ns + np.round(jitter).astype(np.int64)
    is_kept[clock.frame_row] = True
    return np.flatnonzero(is_kept), stamp_ns


def _detect_all(
    scenario: Scenario,
    world: World,
    device: sensors.Device,
    spline: PoseSpline,
    clock: _Clock,
    appearance: scene.SessionAppearance,
    seeds: SessionSeeds,
) -> detection.Detections:
    """Detect with every camera; images and tracks are numbered over all cameras."""
    cameras = device.true_rig.cameras
    time_s = clock.sample_s[clock.frame_row] + clock.lead_s
    parts, tracks = [], 0
    for row, camera in enumerate(cameras):
        at_time = partial(spline.poses_of, T_I_S=device.true_rig.T_B_C[row])
        delay = scenario.cameras[row].line_delay_s
        poses = detection.CameraPoses(time_s, at_time(time_s), delay, at_time)
        detections = detection.detect(
            camera, poses, world, appearance.is_there, scenario.measurement, seeds.measurement
        )
        track = np.where(detections.track >= 0, detections.track + tracks, -1)
        tracks = max(tracks, int(track.max(initial=-1)) + 1)
        frame = detections.frame * len(cameras) + row
        parts.append(dataclasses.replace(detections, frame=frame, track=track))
    joined = detection.Detections.concatenate(parts)
    return joined.take(np.argsort(joined.frame, kind="stable"))


@dataclasses.dataclass(frozen=True, eq=False)
class RecordedSamples:
    """The samples within the part of a trajectory that is used."""

    time_s: F64  # (N,) since the start of that part
    imu: ImuRecording  # with the biases of the trajectory file


def recorded_samples(options: SessionOptions, lead_s: float = 0.0) -> RecordedSamples | None:
    """Read the recorded IMU samples of a session, None if it has simulated ones.

    Args:
        lead_s: Time without samples at both ends of the motion [s].

    Raises:
        UserError: The file has no samples of that time, or the trajectory no biases, which are
            part of the truth.
    """
    if not options.recorded_imu:
        return None
    trajectory = trajectory_motion.read_motion(options)
    if trajectory.gyro_bias is None or trajectory.accel_bias is None:
        raise UserError(
            f"sessions.recorded_imu: {trajectory.source} has no biases, which are part of the truth; "
            "leave recorded_imu out to simulate the samples"
        )
    try:
        samples = read_imu_csv(Path(options.recorded_imu))
    except MapError as error:
        raise UserError(f"sessions.recorded_imu: {error}") from None
    start_ns = trajectory.times_ns[0] + round(options.trajectory_start_s * 1e9)
    time_s = (samples.times_ns - start_ns) * 1e-9
    inside = (time_s >= lead_s) & (time_s <= options.duration_s - lead_s)
    if np.count_nonzero(inside) < 2:
        raise UserError(
            f"sessions.recorded_imu: {options.recorded_imu} has no samples within the "
            f"{options.duration_s:g} s of {trajectory.source} that are used"
        )
    at, known = samples.times_ns[inside], trajectory.times_ns
    biases = (
        np.stack([np.interp(at, known, column) for column in table.T], axis=1)
        for table in (trajectory.accel_bias, trajectory.gyro_bias)
    )
    return RecordedSamples(time_s[inside], ImuRecording(samples.accel_gyro[inside], *biases))
