"""Odometry on whole recordings: error and time of each."""

import dataclasses
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.frontend.mapping import Mapping
from maplab_py.frontend.run_options import RunOptions
from maplab_py.geometry import se3
from maplab_py.geometry.alignment import umeyama
from maplab_py.geometry.interpolation import interpolate_poses
from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.interop.recordings.reader_choice import open_recording
from maplab_py.interop.trajectories import Trajectory, read_trajectory
from maplab_py.storage.native import is_map_folder, load_map

TRUTH = Path("mav0") / "state_groundtruth_estimate0" / "data.csv"
F64 = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class SequenceResult:
    """Errors after SE(3) alignment without closure, and times of a frame."""

    sequence: str
    cameras: int
    frames: int
    starts: int
    first_state_s: float  # after the first frame
    distance_m: float
    ate_m: float  # of the states as they were known at their time; of the first mission
    ate_final_m: float  # of the vertices of the map
    median_m: float
    largest_m: float
    scale: float  # true / estimated
    optvi_ate_m: float  # of the same map after optvi, NaN without truth
    cpu_ms: float  # of a frame, all threads
    median_ms: float  # elapsed
    p99_ms: float


def run(folder: Path, cameras: str = "", options: RunOptions | None = None) -> SequenceResult:
    """Run over an EuRoC folder with truth; or replay a map, judged by its optimisation."""
    if is_map_folder(folder):
        vi_map, _ = load_map(folder)
        recording, truth = MapRecording(vi_map, 0), _optimised_trajectory(vi_map)
        mapping = Mapping(recording, options)
    else:
        recording = open_recording(folder, SourceOptions(rovio_active_camera_indices=cameras))
        truth = read_trajectory(folder / TRUTH)
        mapping = Mapping(recording, options)
    began = time.process_time()
    mapping.run()
    cpu_s = time.process_time() - began
    assert mapping.builder is not None
    online = mapping.trajectory()
    first = mapping.statistics.starts[0]
    final, _ = mapping.builder.finish()
    optimised, _ = optimize(final, VIOptimizationOptions())
    errors, scale = position_errors(truth, online.times_ns, online.T_R_B)
    stages = {stage.stage: stage for stage in mapping.statistics.stages()}
    return SequenceResult(
        sequence=folder.name,
        cameras=len(recording.device.cameras),
        frames=mapping.statistics.frames,
        starts=len(mapping.statistics.starts),
        first_state_s=first.time_s,
        distance_m=mapping.statistics.distance_m,
        ate_m=_rms(errors),
        ate_final_m=_rms(position_errors(truth, final.vertices.timestamp_ns, final.T_G_I)[0]),
        median_m=float(np.median(errors)),
        largest_m=float(errors.max()),
        scale=scale,
        optvi_ate_m=_rms(
            position_errors(truth, optimised.vertices.timestamp_ns, optimised.T_G_I)[0]
        ),
        cpu_ms=1e3 * cpu_s / mapping.statistics.frames,
        median_ms=stages["all stages"].median_ms,
        p99_ms=stages["all stages"].p99_ms,
    )


def position_errors(truth: Trajectory, times_ns: F64, T_G_I: F64) -> tuple[F64, float]:
    """Return distances (N,) after SE(3) alignment, and the scale that a Sim(3) alignment has."""
    T_R_I, is_known = interpolate_poses(truth.times_ns, truth.T_R_B, times_ns, max_gap_ns=10**9)
    p, p_true = T_G_I[is_known, 4:], T_R_I[is_known, 4:]
    T_R_G, _ = umeyama(p_true, p)
    _, scale = umeyama(p_true, p, with_scale=True)
    return np.linalg.norm(se3.transform(T_R_G, p) - p_true, axis=1), float(scale)


def _optimised_trajectory(vi_map: object) -> Trajectory:
    """Return the path of a map after `optvi`, without loop closure."""
    optimised, _ = optimize(vi_map, VIOptimizationOptions())  # type: ignore[arg-type]
    return Trajectory(optimised.vertices.timestamp_ns, optimised.T_G_I)


def _rms(errors: F64) -> float:
    return float(np.sqrt(np.mean(errors**2)))
