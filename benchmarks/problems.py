"""Bundle-adjustment problems of three sizes, the same for every solver that is compared.

A camera looks ahead and outwards while it drives laps around a closed course, one keyframe every
0.2 s. Landmarks are seen from 8 to 15 keyframes in a row; a few places are seen again one lap later,
which closes loops. Body and camera frame coincide, so that no solver pays for extrinsics. The first
two poses are known, which fixes the gauge of the visual problem.

The inertial samples belong to a rotation and position spline through the true poses.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

FOCAL_PX, CENTRE_PX = 460.0, np.array([376.0, 240.0])
IMAGE_PX = np.array([752.0, 480.0])
NUM_KNOWN_POSES = 2
GRAVITY_MPS2 = 9.81

_KEYFRAME_INTERVAL_S = 0.2
_SAMPLES_PER_INTERVAL = 40
_METRES_PER_KEYFRAME = 0.25
_SHORTEST_TRACK, _LONGEST_TRACK, _FEWEST_OBSERVATIONS = 8, 15, 6


@dataclasses.dataclass(frozen=True)
class Size:
    """How large a problem is."""

    num_keyframes: int
    num_landmarks: int
    num_revisited_places: int
    keyframes_per_lap: int


SIZES = {
    "tiny": Size(60, 1_500, 4, 40),
    "small": Size(300, 8_000, 10, 200),
    "medium": Size(1_000, 40_000, 20, 400),
    "large": Size(3_000, 150_000, 40, 600),
}


@dataclasses.dataclass(frozen=True, eq=False)
class VisualProblem:
    """Keyframes that see landmarks: truth, measurements and where to begin."""

    T_G_I: F64  # (V, 7) true poses, camera = body
    p_G: F64  # (L, 3) true landmarks
    initial_T_G_I: F64
    initial_p_G: F64
    start: I64  # (L + 1,) offsets: observations are grouped by landmark
    keyframe: I64  # (O,) ascending within a landmark
    uv_px: F64  # (O, 2), noise of 1 px

    @property
    def landmark(self) -> I64:
        """Landmark row (O,) of every observation."""
        return np.repeat(np.arange(len(self.p_G)), np.diff(self.start))


@dataclasses.dataclass(frozen=True)
class ImuNoise:
    """Densities of white noise and of the biases' walks, in SI units, as of a good MEMS IMU."""

    gyro: float = 2e-4
    accel: float = 1e-2
    gyro_walk: float = 2e-5
    accel_walk: float = 3e-3


@dataclasses.dataclass(frozen=True, eq=False)
class InertialProblem:
    """A visual problem with inertial samples between its keyframes."""

    visual: VisualProblem
    noise: ImuNoise
    first_keyframe: I64  # (E,) where each interval begins; it ends at the next keyframe
    timestamp_ns: I64  # (E, S + 1) of the samples of each interval, both ends included
    accel_gyro: F64  # (E, S + 1, 6)
    gyro_bias: F64  # (3,) true, constant
    accel_bias: F64
    initial_v_G: F64  # (V, 3)
    initial_gyro_bias: F64  # (3,) for every keyframe
    initial_accel_bias: F64


def project(T_G_I: F64, p_G: F64) -> tuple[F64, F64]:
    """Return pixels (N, 2) and depths (N,) of points (N, 3) seen from poses (N, 7)."""
    p_C = Rotation.from_quat(T_G_I[:, :4]).inv().apply(p_G - T_G_I[:, 4:])
    depth = p_C[:, 2]
    return FOCAL_PX * p_C[:, :2] / np.where(depth, depth, 1.0)[:, None] + CENTRE_PX, depth


def make_visual(name: str, seed: int = 0) -> VisualProblem:
    """Make the visual problem of a size; the same every time."""
    size, rng = SIZES[name], np.random.default_rng(seed)
    T_G_I = _drive(size)
    p_G, keyframe, landmark = _tracks(size, T_G_I, rng)
    return disturbed_problem(T_G_I, p_G, keyframe, landmark, rng)


def disturbed_problem(
    T_G_I: F64, p_G: F64, keyframe: I64, landmark: I64, rng: np.random.Generator
) -> VisualProblem:
    """Return a problem with noisy pixels and drifted initial values.

    Args:
        T_G_I: True poses (V, 7).
        p_G: True landmarks (L, 3).
        keyframe: Keyframe (O,) of every observation, ascending within a landmark.
        landmark: Landmark (O,), ascending.
        rng: Random numbers.
    """
    start = np.searchsorted(landmark, np.arange(len(p_G) + 1))
    uv_px = project(T_G_I[keyframe], p_G[landmark])[0] + rng.normal(0.0, 1.0, (len(keyframe), 2))
    initial_T_G_I = _drifted(T_G_I, rng)
    home = keyframe[start[:-1]]
    p_C = Rotation.from_quat(T_G_I[home, :4]).inv().apply(p_G - T_G_I[home, 4:])
    moved = Rotation.from_quat(initial_T_G_I[home, :4]).apply(p_C) + initial_T_G_I[home, 4:]
    initial_p_G = moved + rng.normal(0.0, 0.1, p_G.shape)
    return VisualProblem(T_G_I, p_G, initial_T_G_I, initial_p_G, start, keyframe, uv_px)


def make_inertial(name: str, seed: int = 0) -> InertialProblem:
    """Make the visual-inertial problem of a size; the same every time."""
    visual = make_visual(name, seed)
    return with_inertial_samples(visual, len(visual.T_G_I), np.random.default_rng(seed + 1))


def with_inertial_samples(
    visual: VisualProblem, session_length: int, rng: np.random.Generator
) -> InertialProblem:
    """Return the problem with inertial samples between neighbouring keyframes of each session."""
    noise, count = ImuNoise(), len(visual.T_G_I)
    gyro_bias, accel_bias = np.array([0.010, -0.020, 0.015]), np.array([0.05, -0.08, 0.03])
    first, timestamp_ns, samples, v_G = [], [], [], []
    for begin in range(0, count, session_length):
        session = slice(begin, begin + session_length)
        times, readings = _inertial_samples(visual.T_G_I[session], noise, rng)
        first.append(begin + np.arange(len(times)))
        timestamp_ns.append(times)
        samples.append(readings + np.concatenate([accel_bias, gyro_bias]))
        v_G.append(np.gradient(visual.initial_T_G_I[session, 4:], _KEYFRAME_INTERVAL_S, axis=0))
    return InertialProblem(
        visual=visual,
        noise=noise,
        first_keyframe=np.concatenate(first),
        timestamp_ns=np.concatenate(timestamp_ns),
        accel_gyro=np.concatenate(samples),
        gyro_bias=gyro_bias,
        accel_bias=accel_bias,
        initial_v_G=np.concatenate(v_G),
        initial_gyro_bias=gyro_bias + np.array([3e-4, -2e-4, 2e-4]),
        initial_accel_bias=accel_bias + np.array([-4e-3, 3e-3, 2e-3]),
    )


def _inertial_samples(T_G_I: F64, noise: ImuNoise, rng: np.random.Generator) -> tuple[I64, F64]:
    """Return times (V - 1, S + 1) and noisy readings (V - 1, S + 1, 6) without biases."""
    keyframe_s = np.arange(len(T_G_I)) * _KEYFRAME_INTERVAL_S
    step_s = _KEYFRAME_INTERVAL_S / _SAMPLES_PER_INTERVAL
    sample_s = np.arange((len(keyframe_s) - 1) * _SAMPLES_PER_INTERVAL + 1) * step_s
    position = CubicSpline(keyframe_s, T_G_I[:, 4:])
    orientation = RotationSpline(keyframe_s, Rotation.from_quat(T_G_I[:, :4]))
    force_G = position(sample_s, 2) + np.array([0.0, 0.0, GRAVITY_MPS2])
    accel = orientation(sample_s).inv().apply(force_G)
    gyro = orientation(sample_s, 1)
    measured = np.concatenate(
        [
            accel + rng.normal(0.0, noise.accel / np.sqrt(step_s), accel.shape),
            gyro + rng.normal(0.0, noise.gyro / np.sqrt(step_s), gyro.shape),
        ],
        axis=1,
    )
    first = np.arange(len(keyframe_s) - 1)[:, None] * _SAMPLES_PER_INTERVAL
    rows = first + np.arange(_SAMPLES_PER_INTERVAL + 1)
    return np.round(sample_s[rows] * 1e9).astype(np.int64), measured[rows]


def _drive(size: Size) -> F64:
    """Return the true poses (V, 7): z looks ahead and outwards, y down."""
    k = np.arange(size.num_keyframes)
    turn = 2.0 * np.pi * k / size.keyframes_per_lap
    radius = size.keyframes_per_lap * _METRES_PER_KEYFRAME / (2.0 * np.pi)
    lane = 0.3 * np.sin(0.05 * k) + 0.5 * k / size.keyframes_per_lap
    r = radius * (1.0 + 0.15 * np.sin(3.0 * turn)) + lane
    height = 0.2 * np.sin(7.0 * turn) + 0.1 * np.sin(0.3 * k)
    p = np.column_stack([r * np.cos(turn), r * np.sin(turn), height])
    ahead = np.gradient(p, axis=0)
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0]) + 0.8
    z = np.column_stack([np.cos(yaw), np.sin(yaw), 0.05 * np.sin(0.2 * k)])
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    R_G_C = np.stack([x, np.cross(z, x), z], axis=2)
    return np.concatenate([Rotation.from_matrix(R_G_C).as_quat(), p], axis=1)


def _tracks(size: Size, T_G_I: F64, rng: np.random.Generator) -> tuple[F64, I64, I64]:
    """Return landmarks (L, 3) and, sorted by landmark, keyframe and landmark of each observation.

    More landmarks than wanted are thrown; those seen too rarely are dropped.
    """
    thrown = int(2.2 * size.num_landmarks)
    length = rng.integers(_SHORTEST_TRACK, _LONGEST_TRACK + 1, thrown)
    last_start = size.num_keyframes - length
    begin = np.clip(rng.integers(-5, last_start + 6), 0, last_start)
    begin, is_revisited = _gather_at_places(size, begin, rng)
    p_G = _thrown_in_front_of(T_G_I[begin + length // 2], rng)
    keyframes, landmarks = [], []
    for offset in range(_LONGEST_TRACK):  # a track is at most this long; each pass takes all tracks
        for lap in (0, size.keyframes_per_lap):
            k = begin + offset + lap
            wanted = (offset < length) & (k < size.num_keyframes) & (is_revisited | (lap == 0))
            rows = np.flatnonzero(wanted)
            seen = rows[_is_visible(T_G_I[k[rows]], p_G[rows])]
            keyframes.append(k[seen])
            landmarks.append(seen)
    keyframe, landmark = np.concatenate(keyframes), np.concatenate(landmarks)
    count = np.bincount(landmark, minlength=thrown)
    kept = rng.permutation(np.flatnonzero(count >= _FEWEST_OBSERVATIONS))[: size.num_landmarks]
    kept = kept[np.argsort(begin[kept], kind="stable")]
    row_of = np.full(thrown, -1)
    row_of[kept] = np.arange(len(kept))
    landmark = row_of[landmark]
    order = np.lexsort((keyframe, landmark))
    order = order[landmark[order] >= 0]
    return p_G[kept], keyframe[order], landmark[order]


def _gather_at_places(size: Size, begin: I64, rng: np.random.Generator) -> tuple[I64, Mask]:
    """Move 4 % of the tracks to the places that are seen again a lap later."""
    is_revisited = np.zeros(len(begin), dtype=np.bool_)
    last = size.num_keyframes - size.keyframes_per_lap - 20
    if last <= 10:
        return begin, is_revisited
    places = rng.integers(10, last, size.num_revisited_places)
    count = len(begin) // 25
    begin, is_revisited[:count] = begin.copy(), True
    begin[:count] = np.maximum(rng.choice(places, count) + rng.integers(-6, 6, count), 0)
    return begin, is_revisited


def _thrown_in_front_of(T_G_I: F64, rng: np.random.Generator) -> F64:
    """Return one point (N, 3), 3 to 12 m away, somewhere in the image of each pose (N, 7)."""
    uv = rng.uniform(20.0, IMAGE_PX - 20.0, (len(T_G_I), 2))
    depth = rng.uniform(3.0, 12.0, (len(T_G_I), 1))
    p_C = np.concatenate([(uv - CENTRE_PX) / FOCAL_PX * depth, depth], axis=1)
    return Rotation.from_quat(T_G_I[:, :4]).apply(p_C) + T_G_I[:, 4:]


def _is_visible(T_G_I: F64, p_G: F64) -> Mask:
    uv, depth = project(T_G_I, p_G)
    return (depth > 0.5) & (uv > 0.0).all(axis=1) & (uv < IMAGE_PX).all(axis=1)


def _drifted(T_G_I: F64, rng: np.random.Generator) -> F64:
    """Return poses with a random walk and noise, except for the known ones.

    The walk is slower on longer drives, so that every size begins about as far from the optimum.
    """
    count = len(T_G_I)
    pace = min(1.0, np.sqrt(300.0 / count))
    turned = np.cumsum(rng.normal(0.0, 6e-4 * pace, (count, 3)), axis=0)
    moved = np.cumsum(rng.normal(0.0, 4e-3 * pace, (count, 3)), axis=0)
    turned -= turned[NUM_KNOWN_POSES - 1]
    moved -= moved[NUM_KNOWN_POSES - 1]
    turned += rng.normal(0.0, 2e-3, (count, 3))
    moved += rng.normal(0.0, 1e-2, (count, 3))
    turned[:NUM_KNOWN_POSES] = 0.0
    moved[:NUM_KNOWN_POSES] = 0.0
    q = Rotation.from_quat(T_G_I[:, :4]) * Rotation.from_rotvec(turned)
    return np.concatenate([q.as_quat(), T_G_I[:, 4:] + moved], axis=1)
