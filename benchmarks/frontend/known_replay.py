"""Replays of a recorded mission with known truth: `python -m benchmarks.frontend.known_replay`.

A mission is optimised until it converges, and taken as the truth. Its keypoints become the projections of its
landmarks plus noise; its IMU samples are changed as little as needed to agree with the states, with
constant biases, and get noise of the stated densities. Motion, tracks and their lengths are those that were
recorded. Of the odometry and of `optvi` on the same measurements: position errors after SE(3) alignment, and
the scale. Outliers, calibration and the model of the IMU are perfect, so that what is left is the estimator.
"""

import argparse
import dataclasses
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.frontend.sequences import position_errors
from maplab_py.algorithms.landmarks.sightings import cameras_of
from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.imu.preintegration import integrate
from maplab_py.estimation.window.options import WindowOptions
from maplab_py.frontend.mapping import Mapping
from maplab_py.frontend.odometry_options import OdometryOptions
from maplab_py.frontend.run_options import OutputOptions, RunOptions
from maplab_py.geometry import se3, so3
from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.interop.recordings.options import StreamOptions
from maplab_py.interop.trajectories import Trajectory
from maplab_py.sensors.projection import project
from maplab_py.storage.native import load_map
from maplab_py.vimap import VIMap
from tests.support.data import shared_data_folder

F64 = NDArray[np.float64]
_RUNS, _ITERATIONS = 4, 40
_LARGEST_ERROR_PX = 5.0
"""Keypoints that far from the projection of their landmark are outliers, and left out."""
_STEP, _NEWTON_STEPS = 1e-4, 3


@dataclasses.dataclass(frozen=True)
class KnownReplay:
    """Errors of one replay."""

    variant: str
    seed: int
    scale: float  # true / estimated
    median_m: float
    largest_m: float
    optvi_scale: float
    optvi_median_m: float
    optvi_largest_m: float


def converged(vi_map: VIMap) -> VIMap:
    """Return a map after so many optimisations that the scale has stopped to change."""
    options = VIOptimizationOptions(num_iterations=_ITERATIONS, function_tolerance=1e-9)
    for _ in range(_RUNS):
        vi_map, _ = optimize(vi_map, options)
    return vi_map


def consistent(vi_map: VIMap, noise_px: float, imu_share: float, seed: int) -> VIMap:
    """Return a map whose measurements agree with its states but for Gaussian noise.

    Args:
        vi_map: A converged map of one mission and one IMU.
        noise_px: Standard deviation of the keypoints.
        imu_share: Noise of the IMU samples as a share of the stated densities.
        seed: Of all noise.
    """
    rng = np.random.default_rng(seed)
    keypoints = np.flatnonzero(vi_map.keypoints.landmark >= 0)
    uv_px, agrees = _projections(vi_map, keypoints)
    new_uv_px = np.array(vi_map.keypoints.uv_px)
    new_uv_px[keypoints] = uv_px + noise_px * rng.standard_normal(uv_px.shape)
    landmark, track_id = np.array(vi_map.keypoints.landmark), np.array(vi_map.keypoints.track_id)
    landmark[keypoints[~agrees]] = track_id[keypoints[~agrees]] = -1
    vertices = vi_map.vertices
    biases = {
        name: np.tile(getattr(vertices, name).mean(axis=0), (len(vertices), 1))
        for name in ("gyro_bias", "accel_bias")
    }
    vi_map = vi_map.replace(
        vertices=vertices.replace(**biases),
        keypoints=vi_map.keypoints.replace(uv_px=new_uv_px, landmark=landmark, track_id=track_id),
    )
    samples = _agreeing_samples(vi_map) + _imu_noise(vi_map, imu_share, rng)
    return vi_map.replace(imu_samples=vi_map.imu_samples.replace(accel_gyro=samples))


def _projections(vi_map: VIMap, keypoints: NDArray[np.int64]) -> tuple[F64, NDArray[np.bool_]]:
    """Return where landmarks project (O, 2), and whether keypoints (O,) were recorded near there."""
    p_G = vi_map.p_G[vi_map.keypoints.landmark[keypoints]]
    uv_px, agrees = np.zeros((len(keypoints), 2)), np.zeros(len(keypoints), dtype=np.bool_)
    for camera, T_I_C, rows in cameras_of(vi_map, keypoints):
        T_G_C = se3.compose(vi_map.T_G_I[vi_map.keypoint_vertex[keypoints[rows]]], T_I_C)
        p_C = se3.transform(se3.inverse(T_G_C), p_G[rows])
        uv_px[rows], is_visible = project(camera, p_C)
        error = np.linalg.norm(uv_px[rows] - vi_map.keypoints.uv_px[keypoints[rows]], axis=1)
        agrees[rows] = is_visible & (p_C[:, 2] > 0.0) & (error < _LARGEST_ERROR_PX)
    return uv_px, agrees


def _agreeing_samples(vi_map: VIMap) -> F64:
    """Return samples (N, 6) whose integrals agree with the states.

    The angular velocity of an edge changes by a constant, the acceleration by a linear function of time:
    nine numbers for as many residuals.
    """
    data = InertialData.of_map(vi_map)
    edge = np.repeat(np.arange(len(data)), np.diff(data.sample_start))
    times_s = (data.timestamp_ns - data.timestamp_ns[data.sample_start[:-1]][edge]) * 1e-9
    since_s = times_s - 0.5 * data.duration_s[edge]

    def changed(change: F64) -> InertialData:
        values = data.accel_gyro.copy()
        values[:, :3] += change[edge, :3] + change[edge, 3:6] * since_s[:, None]
        values[:, 3:] += change[edge, 6:]
        return dataclasses.replace(data, accel_gyro=values)

    change = np.zeros((len(data), 9))
    for _ in range(_NEWTON_STEPS):
        residual = _residuals(vi_map, changed(change))
        jacobian = np.empty((len(data), 9, 9))
        for column in range(9):
            step = change.copy()
            step[:, column] += _STEP
            jacobian[:, :, column] = (_residuals(vi_map, changed(step)) - residual) / _STEP
        change -= np.linalg.solve(jacobian, residual[:, :, None])[:, :, 0]
    return changed(change).accel_gyro


def _residuals(vi_map: VIMap, data: InertialData) -> F64:
    """Return turn, velocity and position (E, 9) by which states differ from integrated samples."""
    first, second = vi_map.imu_edges.from_vertex, vi_map.imu_edges.to_vertex
    vertices = vi_map.vertices
    edges = integrate(data, vertices.gyro_bias[first], vertices.accel_bias[first])
    T_A, T_B = vertices.T_M_I[first], vertices.T_M_I[second]
    v_A, v_B, dt = vertices.v_M[first], vertices.v_M[second], edges.duration_s[:, None]
    g_M = np.array([0.0, 0.0, -data.imus[0].gravity_magnitude_mps2])
    q_M_A = so3.inverse(T_A[:, :4])
    turn = so3.multiply(so3.inverse(edges.q_A_B), so3.multiply(q_M_A, T_B[:, :4]))
    dv = so3.rotate(q_M_A, v_B - v_A - g_M * dt) - edges.dv
    dp = so3.rotate(q_M_A, T_B[:, 4:] - T_A[:, 4:] - v_A * dt - 0.5 * g_M * dt**2) - edges.dp
    return np.concatenate([so3.log(turn), dv, dp], axis=1)


def _imu_noise(vi_map: VIMap, share: float, rng: np.random.Generator) -> F64:
    """Return noise (N, 6), equal where neighbouring edges repeat a sample."""
    imu = InertialData.of_map(vi_map).imus[0]
    times_ns, row = np.unique(vi_map.imu_samples.timestamp_ns, return_inverse=True)
    root_hz = 1.0 / np.sqrt(float(np.median(np.diff(times_ns))) * 1e-9)
    density = np.repeat([imu.acc_noise_density, imu.gyro_noise_density], 3)
    noise: F64 = share * root_hz * density * rng.standard_normal((len(times_ns), 6))
    return noise[row]


def run(vi_map: VIMap, truth: Trajectory, variant: str, seed: int, end_s: float) -> KnownReplay:
    """Replay a map, and optimise what comes of it."""
    options = RunOptions(
        stream=StreamOptions(end_s=end_s),
        odometry=OdometryOptions(window=VARIANTS[variant]),
        output=OutputOptions(),
    )
    mapping = Mapping(MapRecording(vi_map, 0), options)
    mapping.run()
    assert mapping.builder is not None
    online = mapping.trajectory()
    errors, scale = position_errors(truth, online.times_ns, online.T_R_B)
    optimised, _ = mapping.builder.finish()
    for _ in range(2):
        optimised, _ = optimize(optimised, VIOptimizationOptions())
    best, best_scale = position_errors(truth, optimised.vertices.timestamp_ns, optimised.T_G_I)
    return KnownReplay(
        variant, seed,
        scale, float(np.median(errors)), float(errors.max()),
        best_scale, float(np.median(best)), float(best.max()),
    )  # fmt: skip


VARIANTS = {
    "as it is": WindowOptions(),
    "12 keyframes": WindowOptions(num_keyframes=12),
}
"""Choices that are compared."""


def main() -> None:
    """Replay with all seeds; print the errors and their means, write JSON if asked to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=62.0)
    parser.add_argument("--pixels", type=float, default=0.8)
    parser.add_argument("--imu", type=float, default=1.0, help="share of the stated densities")
    parser.add_argument("--variants", nargs="*", default=list(VARIANTS))
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    vi_map, _ = load_map(shared_data_folder() / "maplab_maps" / "tango_handheld")
    vi_map = converged(vi_map)
    truth = Trajectory(vi_map.vertices.timestamp_ns, vi_map.T_G_I)
    results = []
    for seed in range(1, arguments.seeds + 1):
        measured = consistent(vi_map, arguments.pixels, arguments.imu, seed)
        for variant in arguments.variants:
            results.append(run(measured, truth, variant, seed, arguments.seconds))
            print({k: _rounded(v) for k, v in dataclasses.asdict(results[-1]).items()}, flush=True)
    for variant in arguments.variants:
        table = np.array([dataclasses.astuple(r)[2:] for r in results if r.variant == variant])
        spread = table.std(axis=0, ddof=1)[0] if len(table) > 1 else np.nan
        print(f"{variant}: mean {table.mean(axis=0).round(4)}, scale +- {spread:.4f}")
    if arguments.json:
        content = json.dumps([dataclasses.asdict(result) for result in results], indent=1)
        arguments.json.write_text(content + "\n", encoding="utf-8")


def _rounded(value: float | str) -> float | str:
    return value if isinstance(value, str) else round(value, 4)


if __name__ == "__main__":
    main()
