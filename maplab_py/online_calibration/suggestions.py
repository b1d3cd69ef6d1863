"""Motions that would teach a device most about its calibration, by segments simulated with its sensors."""

import dataclasses
from collections.abc import Iterator, Mapping

import numpy as np

from maplab_py.algorithms.self_calibration.changes import joint_covariance
from maplab_py.algorithms.self_calibration.estimation.parameters import Parameters
from maplab_py.algorithms.self_calibration.estimation.problem import build_segment_problem
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.segments.database import SegmentDatabase
from maplab_py.algorithms.self_calibration.segments.selection import evaluate
from maplab_py.algorithms.self_calibration.uncertainty import name_directions
from maplab_py.array_types import F64, I64
from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3
from maplab_py.online_calibration.options import WantedSigmas
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report
from maplab_py.sensors import ImuIntrinsics, SensorSet, calibration_transfer
from maplab_py.simulation import scene, session, trajectory_motion
from maplab_py.simulation import sensors as simulated
from maplab_py.simulation.recording import SessionSeeds, record
from maplab_py.simulation.scenario import (
    AppearanceOptions,
    CameraOptions,
    DriftOptions,
    ImuOptions,
    MeasurementOptions,
    Scenario,
    SessionOptions,
    WorldOptions,
)
from maplab_py.simulation.world import make_world
from maplab_py.vimap import VIMap

_R_G_C = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""The first camera looks along x of G, level."""
_ROOM_M = (8.0, 6.0, 3.0)
_HEIGHT_M = 1.4
_WALK_MPS, _SWAY_M, _SWAY_RAD = 0.15, 0.015, 0.03
"""Motion of the hand that carries the device beside the motion that is asked for."""
_IMU_RATE_HZ = 200.0


@dataclasses.dataclass(frozen=True)
class Motion:
    """Oscillation of the first camera C in front of a wall; amplitudes in C (x right, y down)."""

    words: str
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    move_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    hertz: float = 0.5
    wall_m: float = 2.5

    def poses(self, time_s: F64) -> F64:
        """Return T_C0_C (N, 7) at times (N,)."""
        phase = 2.0 * np.pi * self.hertz * time_s[:, None]
        beats = np.array([1.0, 1.31, 0.77])  # so that several axes do not move as one
        is_mixed = np.count_nonzero(self.turn_deg) + np.count_nonzero(self.move_m) > 1
        wave = np.sin(phase * (beats if is_mixed else 1.0) + np.array([0.0, 0.9, 1.7]))
        sway = np.sin(2.0 * np.pi * np.array([0.6, 0.8, 0.7]) * time_s[:, None] + [0.3, 1.1, 2.0])
        turn = np.deg2rad(self.turn_deg) * wave + _SWAY_RAD * sway
        move = np.array(self.move_m) * wave[:, ::-1] + _SWAY_M * sway[:, ::-1]
        move[:, 0] += _WALK_MPS * (time_s - 0.5 * time_s[-1])
        return se3.make(so3.exp(turn), move)


_TURNS = {
    "the optical axis, like a steering wheel,": 2,
    "the vertical, left and right,": 1,
    "the horizontal, up and down,": 0,
}
_MOVES = {"along the optical axis": 2, "sideways": 0, "up and down": 1}


def _along(axis: int, amplitude: float) -> tuple[float, float, float]:
    first, second, third = (amplitude if k == axis else 0.0 for k in range(3))
    return first, second, third


MOTIONS = (
    *(
        Motion(f"turn about {words} by 60 deg, twice", turn_deg=_along(axis, 30.0))
        for words, axis in _TURNS.items()
    ),
    *(
        Motion(f"accelerate {words} to and fro by 3 m/s^2", move_m=_along(axis, 0.135), hertz=0.75)
        for words, axis in _MOVES.items()
    ),
    Motion(
        "come within 1 m of a textured wall and move along it",
        move_m=(0.3, 0.2, 0.0),
        wall_m=0.9,
        hertz=0.4,
    ),
    Motion(
        "turn about all axes by 50 deg while you move to and fro by 20 cm",
        turn_deg=(25.0, 25.0, 25.0),
        move_m=(0.1, 0.1, 0.1),
        hertz=0.7,
    ),
    Motion(
        "within 1 m of a textured wall, turn about all axes by 50 deg",
        turn_deg=(25.0, 25.0, 25.0),
        move_m=(0.1, 0.1, 0.0),
        hertz=0.6,
        wall_m=1.0,
    ),
)
"""Motions that a person can make in a few seconds."""


@dataclasses.dataclass(frozen=True)
class Suggestion:
    """A motion, and the deviation that would be left of the least known parameter."""

    motion: str
    parameter: str
    sigma_before: float
    sigma_after: float
    is_sufficient: bool  # afterwards all parameters are known as well as wanted


class SuggestionReport(Report):
    """Motions that would teach most about the calibration, the best first, one after the other."""

    segments: int  # that are known already
    unknown: tuple[str, ...]  # directions that are known least
    suggestions: tuple[Suggestion, ...]
    known_share: float  # of the way from no data to the wanted deviations
    sufficient: bool  # all parameters are known as well as wanted


def suggest_motion(
    database: SegmentDatabase,
    options: SelfCalibrationOptions,
    wanted: WantedSigmas,
    *,
    count: int = 3,
    progress: Progress = SILENT,
) -> SuggestionReport:
    """Suggest motions from what the segments of a database leave unknown.

    Raises:
        EstimationError: The segments have no information.
        UserError: The database is empty.
    """
    if not len(database):
        raise UserError("the database has no segment: collect some, of any motion")
    evaluation = evaluate(database.vi_map, options, progress=progress)
    parameters = evaluation.parameters
    tolerance = wanted_sigma(database.vi_map, options, wanted)
    covariance = joint_covariance(
        [segment.covariance for segment in evaluation.segments], parameters.prior_sigma
    )
    library = simulated_covariances(database.vi_map.sensors, options, progress=progress)
    chosen = [
        suggestion
        for suggestion, _ in zip(
            suggestions(covariance, library, parameters, tolerance), range(count), strict=False
        )
    ]
    sigma = np.sqrt(np.diag(covariance))
    return SuggestionReport(
        segments=len(evaluation.segments),
        unknown=least_known(covariance, parameters, tolerance),
        suggestions=tuple(chosen),
        known_share=known_share(sigma, parameters.prior_sigma, tolerance),
        sufficient=bool(np.all(sigma <= tolerance)),
    )


def wanted_sigma(vi_map: VIMap, options: SelfCalibrationOptions, wanted: WantedSigmas) -> F64:
    """Return the wanted deviations (k,) of the parameters of a map."""
    problem = build_segment_problem(vi_map, wanted.as_priors(options), robust=False)
    return problem.parameters.prior_sigma


def known_share(sigma: F64, prior_sigma: F64, tolerance: F64) -> float:
    """Return how far deviations (k,) have come from the prior's to the wanted ones; 1 = all the way.

    The mean over the parameters of the way on a logarithmic scale.
    """
    left = np.log(np.maximum(sigma / tolerance, 1.0))
    whole = np.log(np.maximum(prior_sigma / tolerance, 1.0))
    share = np.ones(len(left))
    np.divide(whole - left, whole, out=share, where=whole > 0.0)
    return float(np.clip(share, 0.0, 1.0).mean())


def least_known(covariance: F64, parameters: Parameters, tolerance: F64) -> tuple[str, ...]:
    """Return the parameters of the three directions whose deviation exceeds the wanted one most."""
    _, directions = np.linalg.eigh(covariance / np.outer(tolerance, tolerance))
    return tuple(dict.fromkeys(name_directions(directions[:, :-4:-1], parameters)))


def suggestions(
    covariance: F64,
    library: Mapping[str, F64],
    parameters: Parameters,
    tolerance: F64,
    rows: I64 | None = None,
) -> Iterator[Suggestion]:
    """Yield motions without end, each the best after those before.

    The best motion leaves the smallest sum of squared deviations in units of the wanted ones.

    Args:
        covariance: What is known (k, k).
        library: Covariance (k, k) given a segment of every motion and the prior, by its words.
        parameters: What is calibrated.
        tolerance: Wanted deviations (k,).
        rows: Parameters that matter; None = all.
    """
    rows = np.arange(len(parameters)) if rows is None else rows
    prior = np.diag(parameters.prior_sigma**-2.0)
    gain = {words: np.linalg.inv(each) - prior for words, each in library.items()}
    while True:
        information = np.linalg.inv(covariance)
        after: dict[str, F64] = {
            words: np.asarray(np.linalg.inv(information + each)) for words, each in gain.items()
        }
        share = {words: np.diag(each)[rows] / tolerance[rows] ** 2 for words, each in after.items()}
        best = min(share, key=lambda words: float(share[words].sum()))
        worst = int(rows[np.argmax(np.diag(covariance)[rows] / tolerance[rows] ** 2)])
        before, left = (float(np.sqrt(each[worst, worst])) for each in (covariance, after[best]))
        is_sufficient = bool(np.all(share[best] <= 1.0))
        yield Suggestion(best, parameters.names[worst], before, left, is_sufficient)
        covariance = after[best]


def simulated_covariances(
    sensors: SensorSet, options: SelfCalibrationOptions, *, progress: Progress = SILENT
) -> dict[str, F64]:
    """Return the covariance (k, k) that a simulated segment of every motion leaves, by its words."""
    result = {}
    for number, motion in enumerate(MOTIONS):
        progress.step(number, len(MOTIONS), "simulate motions")
        segment = simulated_segment(sensors, motion, options.segment_keyframes)
        result[motion.words] = evaluate(segment, options).segments[0].covariance
    return result


def simulated_segment(
    sensors: SensorSet, motion: Motion, keyframes: int = 40, seed: int = 1
) -> VIMap:
    """Return a segment of a motion in a room, recorded by a device with exactly its calibration."""
    device = calibration_transfer.only_device(sensors)
    scenario = _scenario(sensors, device, keyframes)
    world = make_world(scenario.world, np.random.default_rng(seed))
    rigs = sensors.camera_rig(device.rig)
    rig = dataclasses.replace(rigs, T_B_C=sensors.T_I_C(*device))
    imu = sensors.imu(device.imu)
    of_scenario = simulated.Device(sensors, device.imu, rig, rig, imu.intrinsics or ImuIntrinsics())
    count = int(scenario.sessions[0].total_s / trajectory_motion.KNOT_SPACING_S) + 3
    place = np.array([0.5 * _ROOM_M[0] - motion.wall_m, 0.0, _HEIGHT_M])
    T_G_C0 = se3.make(so3.from_matrix(_R_G_C), place)
    time_s: F64 = np.asarray(trajectory_motion.KNOT_SPACING_S * np.arange(count), dtype=np.float64)
    T_C0_C = motion.poses(time_s)
    T_G_I = se3.compose(se3.compose(T_G_C0, T_C0_C), se3.inverse(rig.T_B_C[0]))
    generators = np.random.default_rng(seed).spawn(5)
    seeds = SessionSeeds(*generators)
    look = scene.make_session_appearance(
        scene.make_appearance(scenario.appearance, world.look, generators[2]), generators[2]
    )
    spline = trajectory_motion.through(T_G_I, trajectory_motion.KNOT_SPACING_S)
    recording = record(scenario, 0, world, of_scenario, look, seeds, spline)
    return session.session_map(scenario, world, of_scenario, recording, seeds)[0]


def _scenario(sensors: SensorSet, device: calibration_transfer.Device, keyframes: int) -> Scenario:
    imu, cameras = sensors.imu(device.imu), sensors.camera_rig(device.rig).cameras
    rate_hz = 10.0
    return Scenario(
        world=WorldOptions(room_size_m=_ROOM_M, furniture_per_room=0, patchiness=0.0),
        imu=ImuOptions(
            rate_hz=_IMU_RATE_HZ,
            gyro_noise_density=imu.gyro_noise_density,
            accel_noise_density=imu.acc_noise_density,
            gyro_bias_walk=imu.gyro_bias_random_walk_noise_density,
            accel_bias_walk=imu.acc_bias_random_walk_noise_density,
            gravity_mps2=imu.gravity_magnitude_mps2,
        ),
        cameras=tuple(
            CameraOptions(
                width_px=c.width_px, height_px=c.height_px, line_delay_s=1e-9 * c.line_delay_ns
            )
            for c in cameras
        ),
        measurement=MeasurementOptions(
            frame_rate_hz=rate_hz, max_keypoints=150, clutter_share=0.0, identity_swap_share=0.0
        ),
        appearance=AppearanceOptions(descriptor_bytes=1, vanish_share=0.0),
        drift=DriftOptions(*[0.0] * len(dataclasses.fields(DriftOptions))),
        sessions=(SessionOptions(duration_s=(keyframes - 1) / rate_hz),),
    )
