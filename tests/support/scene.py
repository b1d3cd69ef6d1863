"""Maps made by hand whose inertial samples fit the discrete integration to the last digit.

The body walks round a circle inside a ball of landmarks and looks outwards. Orientations and
accelerations at the samples are analytic; velocities and positions follow from them by the rule
that `estimation.imu.kernels` states, and the samples by solving that rule for what was measured.
Nothing here uses the code under test but the camera models of `sensors`.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.geometry import se3, so3
from maplab_py.sensors import Camera, CameraRig, Distortion, Imu, ImuIntrinsics, Projection
from maplab_py.sensors.camera import CAMERA_MODELS
from maplab_py.sensors.projection import is_inside_image, project
from maplab_py.sensors.sensor_set import Extrinsics, SensorSet
from maplab_py.vimap import VIMap, from_hex, random_ids, tables, to_hex
from tests.support.imu_model import distort_imu

F64 = NDArray[np.float64]

EVERY_MODEL = CAMERA_MODELS
_DISTORTION = {
    Distortion.NONE: [],
    Distortion.RADTAN: [-0.28, 0.07, 1e-3, -5e-4],
    Distortion.RADTAN5: [-0.28, 0.07, 1e-3, -5e-4, 0.01],
    Distortion.RATIONAL: [0.3, -0.1, 1e-3, -5e-4, 0.02, 0.5, 0.05, 0.01],
    Distortion.EQUIDISTANT: [-0.01, 0.02, -0.01, 0.003],
    Distortion.FOV: [0.93],
}
_R_I_C = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""C looks along x of I: x_C = -y_I, y_C = -z_I, z_C = x_I."""


@dataclasses.dataclass(frozen=True)
class Scene:
    """What to make; `noise` scales the noise that keypoints and IMU announce, 0 = perfect."""

    missions: int = 1
    vertices: int = 12  # of each mission
    interval_s: float = 0.2
    rate_hz: int = 200
    landmarks: int = 250
    seen_share: float = 1.0  # of the landmarks in view
    models: tuple[tuple[Projection, Distortion], ...] = ((Projection.PINHOLE, Distortion.RADTAN),)
    noise: float = 0.0
    gravity_mps2: float = 9.81
    intrinsics: ImuIntrinsics | None = None
    seed: int = 1
    device_seed: int | None = None  # None: every seed has a device of its own

    def make(self) -> VIMap:
        """Return the map: true states, measurements as asked for."""
        rng = np.random.default_rng(self.seed)
        drawn = rng if self.device_seed is None else np.random.default_rng(self.device_seed)
        imu = Imu(
            _new_id(drawn), gravity_magnitude_mps2=self.gravity_mps2, intrinsics=self.intrinsics
        )
        rig = _rig(self.models, drawn)
        sensors = SensorSet(
            {imu.id: imu, rig.id: rig},
            {i: Extrinsics(imu.id, se3.identity()) for i in (imu.id, rig.id)},
        )
        walks = [_walk(self, mission, imu, rng) for mission in range(self.missions)]
        T_G_M = se3.make(
            so3.exp(rng.uniform(-3.0, 3.0, (self.missions, 1)) * [0.0, 0.0, 1.0]),
            rng.uniform(-5.0, 5.0, (self.missions, 3)),
        )
        mission = np.repeat(np.arange(self.missions), self.vertices)
        T_G_I = np.concatenate([walk.T_G_I for walk in walks])
        frames, keypoints, landmarks = _images(self, rig, T_G_I, rng)
        sensor_id = np.zeros((self.missions, len(tables.MissionSensor), 2), dtype=np.uint64)
        sensor_id[:, tables.MissionSensor.IMU] = from_hex(imu.id)
        sensor_id[:, tables.MissionSensor.NCAMERA] = from_hex(rig.id)
        count = len(T_G_I)
        edges, samples = _imu_tables(self, walks, rng)
        q_M_G = so3.inverse(T_G_M[mission, :4])
        return VIMap(
            sensors=sensors,
            missions=tables.Missions.filled(
                self.missions,
                id=random_ids(self.missions, rng),
                baseframe=np.arange(self.missions),
                root_vertex=np.arange(self.missions) * self.vertices,
                sensor_id=sensor_id,
            ),
            baseframes=tables.BaseFrames.filled(
                self.missions, id=random_ids(self.missions, rng), T_G_M=T_G_M
            ),
            vertices=tables.Vertices.filled(
                count,
                id=random_ids(count, rng),
                mission=mission,
                T_M_I=se3.compose(se3.inverse(T_G_M[mission]), T_G_I),
                v_M=so3.rotate(q_M_G, np.concatenate([walk.v_G for walk in walks])),
                accel_bias=np.concatenate([walk.accel_bias for walk in walks]),
                gyro_bias=np.concatenate([walk.gyro_bias for walk in walks]),
                timestamp_ns=np.concatenate([walk.vertex_time_ns for walk in walks]),
                nframe_id=random_ids(count, rng),
            ),
            frames=frames,
            keypoints=keypoints,
            landmarks=landmarks,
            imu_edges=edges,
            imu_samples=samples,
        )


@dataclasses.dataclass(frozen=True, eq=False)
class _Walk:
    """States at the vertices and everything the IMU reported."""

    T_G_I: F64
    v_G: F64
    accel_bias: F64
    gyro_bias: F64
    vertex_time_ns: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    accel_gyro: F64


def _walk(scene: Scene, mission: int, imu: Imu, rng: np.random.Generator) -> _Walk:
    per_edge = round(scene.interval_s * scene.rate_hz)
    count = (scene.vertices - 1) * per_edge + 1
    step_ns = 1_000_000_000 // scene.rate_hz
    dt, t = step_ns * 1e-9, np.arange(count) * step_ns * 1e-9
    radius, speed, phase = 2.0 - 0.2 * mission, 0.7, 0.5 * mission
    angle = speed * t + phase
    zero = np.zeros(count)
    a_G = np.stack(
        [
            -radius * speed**2 * np.cos(angle),
            -radius * speed**2 * np.sin(angle),
            -0.9 * np.sin(3.0 * t + phase),
        ],
        axis=1,
    )
    v_0 = [-radius * speed * np.sin(phase), radius * speed * np.cos(phase), 0.3 * np.cos(phase)]
    v_G = v_0 + _trapezoid(a_G, dt)
    p_0 = [radius * np.cos(phase), radius * np.sin(phase), 0.3 * mission]
    # the acceleration changes evenly between samples: v_0 dt + (2 a_0 + a_1) dt^2 / 6
    p_G = p_0 + _trapezoid(v_G, dt) - (a_G - a_G[0]) * dt**2 / 12.0
    heading = so3.exp(np.stack([zero, zero, angle], axis=1))
    tilt = so3.exp(np.stack([0.2 * np.sin(1.9 * t), 0.15 * np.sin(2.3 * t + 1.0), zero], axis=1))
    q_G_I = so3.normalize(so3.multiply(heading, tilt))
    gravity_G = [0.0, 0.0, -scene.gravity_mps2]
    force = so3.rotate(so3.inverse(q_G_I), a_G - gravity_G)
    turn = so3.log(so3.multiply(so3.inverse(q_G_I[:-1]), q_G_I[1:]))
    rate = _values_of_means(turn / dt)
    b_a = np.array([0.1, -0.05, 0.08]) + _bias_walk(
        scene, imu.acc_bias_random_walk_noise_density, count, rng
    )
    b_g = np.array([0.01, 0.02, -0.015]) + _bias_walk(
        scene, imu.gyro_bias_random_walk_noise_density, count, rng
    )
    readings = distort_imu(imu.intrinsics, np.concatenate([force, rate], axis=1), b_a, b_g)
    sigma = np.repeat([imu.acc_noise_density, imu.gyro_noise_density], 3) / np.sqrt(dt)
    readings = readings + scene.noise * sigma * rng.standard_normal((count, 6))
    time_ns = 1_000_000_000 * (1 + 1000 * mission) + np.arange(count) * step_ns
    at = np.arange(scene.vertices) * per_edge
    return _Walk(
        se3.make(q_G_I, p_G)[at], v_G[at], b_a[at], b_g[at], time_ns[at], time_ns, readings
    )


def _trapezoid(values: F64, dt: float) -> F64:
    """Integrate samples (N, 3) by the trapezoidal rule, from zero."""
    steps = 0.5 * dt * (values[1:] + values[:-1])
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def _values_of_means(means: F64) -> F64:
    """Return values (N + 1, 3) of which neighbours have the given means (N, 3)."""
    sign = np.where(np.arange(len(means)) % 2 == 0, 1.0, -1.0)[:, None]
    first = 1.5 * means[:1] - 0.5 * means[1:2]
    # s_k x_k falls by 2 s_k mean_k at every step, since x_k + x_{k+1} = 2 mean_k
    signed = first - np.concatenate([np.zeros((1, 3)), np.cumsum(2.0 * sign * means, axis=0)])
    return np.asarray(signed * np.concatenate([sign, -sign[-1:]]))


def _bias_walk(scene: Scene, density: float, count: int, rng: np.random.Generator) -> F64:
    steps = scene.noise * density / np.sqrt(scene.rate_hz) * rng.standard_normal((count, 3))
    return np.cumsum(steps, axis=0)


def _imu_tables(
    scene: Scene, walks: list[_Walk], rng: np.random.Generator
) -> tuple[tables.ImuEdges, tables.ImuSamples]:
    """Cut the recordings at the vertices; neighbouring edges share a sample."""
    per_edge = round(scene.interval_s * scene.rate_hz)
    begin = np.arange(scene.vertices - 1)
    rows = (begin[:, None] * per_edge + np.arange(per_edge + 1)).reshape(-1)
    first = (np.arange(scene.missions)[:, None] * scene.vertices + begin).reshape(-1)
    edges = tables.ImuEdges.filled(
        len(first),
        id=random_ids(len(first), rng),
        from_vertex=first,
        to_vertex=first + 1,
        sample_count=np.full(len(first), per_edge + 1),
    )
    return edges, tables.ImuSamples.filled(
        len(rows) * len(walks),
        timestamp_ns=np.concatenate([walk.time_ns[rows] for walk in walks]),
        accel_gyro=np.concatenate([walk.accel_gyro[rows] for walk in walks]),
    )


def _images(
    scene: Scene, rig: CameraRig, T_G_I: F64, rng: np.random.Generator
) -> tuple[tables.Frames, tables.Keypoints, tables.Landmarks]:
    """Show every vertex the landmarks in its cameras' views; those seen twice become part."""
    direction = rng.normal(size=(scene.landmarks, 3)) * [1.0, 1.0, 0.45]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    p_G = direction * rng.uniform(4.5, 8.0, (scene.landmarks, 1))
    cameras, vertices = len(rig.cameras), len(T_G_I)
    uv = np.empty((vertices, cameras, scene.landmarks, 2))
    seen = np.empty((vertices, cameras, scene.landmarks), dtype=bool)
    for row, camera in enumerate(rig.cameras):
        T_C_G = se3.inverse(se3.compose(T_G_I, rig.T_B_C[row]))
        p_C = se3.transform(T_C_G[:, None], p_G)
        uv[:, row], visible = project(camera, p_C)
        seen[:, row] = visible & is_inside_image(camera, uv[:, row]) & (p_C[..., 2] > 0.5)
    seen &= rng.random(seen.shape) < scene.seen_share
    seen[:, :, seen.any(axis=1).sum(axis=0) < 3] = False
    kept = np.flatnonzero(seen.any(axis=(0, 1)))
    row_of_landmark = np.cumsum(seen.any(axis=(0, 1))) - 1
    vertex, camera_row, landmark = np.nonzero(seen)
    home = np.argmax(seen.any(axis=1)[:, kept], axis=0)
    sigma = np.full(len(vertex), 0.8)
    noise = scene.noise * sigma[:, None] * rng.standard_normal((len(vertex), 2))
    frames = tables.Frames.filled(
        vertices * cameras,
        id=random_ids(vertices * cameras, rng),
        vertex=np.repeat(np.arange(vertices), cameras),
        camera_index=np.tile(np.arange(cameras), vertices),
        keypoint_count=seen.sum(axis=2).reshape(-1),
    )
    keypoints = tables.Keypoints.filled(
        len(vertex),
        uv_px=uv[vertex, camera_row, landmark] + noise,
        sigma_px=sigma,
        landmark=row_of_landmark[landmark],
    )
    landmarks = tables.Landmarks.filled(
        len(kept),
        id=random_ids(len(kept), rng),
        vertex=home,
        p_I=se3.transform(se3.inverse(T_G_I[home]), p_G[kept]),
    )
    return frames, keypoints, landmarks


def make_camera(
    projection: Projection, distortion: Distortion, camera_id: str = "0" * 32
) -> Camera:
    """Return a camera of a model, 640 x 480."""
    intrinsics = {
        Projection.PINHOLE: [310.0, 312.0, 321.0, 238.0],
        Projection.UNIFIED: [0.8, 520.0, 523.0, 321.0, 238.0],
        Projection.DOUBLE_SPHERE: [-0.2, 0.6, 250.0, 252.0, 321.0, 238.0],
        Projection.EXTENDED_UNIFIED: [0.6, 1.1, 310.0, 312.0, 321.0, 238.0],
    }[projection]
    parameters = np.array(_DISTORTION[distortion])
    return Camera(camera_id, projection, distortion, np.array(intrinsics), parameters, 640, 480)


def _rig(models: tuple[tuple[Projection, Distortion], ...], rng: np.random.Generator) -> CameraRig:
    count = len(models)
    turn = so3.exp(rng.normal(scale=0.05, size=(count, 3)))
    T_B_C = se3.make(so3.multiply(turn, so3.from_matrix(_R_I_C)), rng.normal(0.0, 0.08, (count, 3)))
    cameras = tuple(make_camera(*model, _new_id(rng)) for model in models)
    return CameraRig(_new_id(rng), cameras, T_B_C)


def _new_id(rng: np.random.Generator) -> str:
    return to_hex(random_ids(1, rng)[0])


def corrupted(
    vi_map: VIMap,
    rng: np.random.Generator,
    *,
    position_m: float = 0.0,
    quaternion: float = 0.0,
    landmark_m: float = 0.0,
    velocity_mps: float = 0.0,
    gyro_bias: float = 0.0,
    accel_bias: float = 0.0,
    keep: int = 1,
) -> VIMap:
    """Disturb states by normal noise as maplab's tests do, but for the first `keep` poses.

    Landmarks are disturbed in the frame of their vertex and are carried along with it. The
    vector part of a unit quaternion gets the noise `quaternion`.
    """
    vertices, landmarks = vi_map.vertices, vi_map.landmarks
    count = len(vertices)
    vector = quaternion * rng.standard_normal((count, 3))
    shift = position_m * rng.standard_normal((count, 3))
    vector[:keep], shift[:keep] = 0.0, 0.0
    turn = so3.normalize(np.concatenate([vector, np.ones((count, 1))], axis=1))
    T_M_I = se3.make(
        so3.normalize(so3.multiply(vertices.T_M_I[:, :4], turn)), vertices.T_M_I[:, 4:] + shift
    )
    return vi_map.replace(
        vertices=vertices.replace(
            T_M_I=T_M_I,
            v_M=vertices.v_M + velocity_mps * rng.standard_normal((count, 3)),
            gyro_bias=vertices.gyro_bias + gyro_bias * rng.standard_normal((count, 3)),
            accel_bias=vertices.accel_bias + accel_bias * rng.standard_normal((count, 3)),
        ),
        landmarks=landmarks.replace(
            p_I=landmarks.p_I + landmark_m * rng.standard_normal((len(landmarks), 3))
        ),
    )


def aligned(T_G_I: F64, reference: F64) -> F64:
    """Move poses (V, 7) by heading and position so that the first position fits the reference.

    Of the headings the one is taken that fits all orientations best.
    """
    turn = so3.log(so3.multiply(reference[:, :4], so3.inverse(T_G_I[:, :4])))
    heading = so3.exp(turn.mean(axis=0) * [0.0, 0.0, 1.0])
    T = se3.make(heading, reference[0, 4:] - so3.rotate(heading, T_G_I[0, 4:]))
    return se3.compose(T, T_G_I)
