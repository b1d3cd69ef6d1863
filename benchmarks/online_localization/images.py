"""A flight in the map of another one, images end to end (thesis, tables 5.1 and 5.2).

Either V1_02 in the map of V1_01, whose images are rendered: the folder is what `simulate --raw_data` has
written of `docs/examples/recorded_flights/vicon_room.yaml`. Or, without a folder, the recorded images of
MH_01: the last 5 s in the map of the 5 s before. The first flight makes a localisation map, aligned with
the truth once by its own vertices. The second is run without a map, whose trajectory is then aligned with
the truth by SE(3), with the map, not aligned, and as a batch: its own map after loop closure and
optimisation, aligned by SE(3).
"""

import dataclasses
from pathlib import Path

import numpy as np

from benchmarks.frontend.frame_times import FrameWatch
from benchmarks.frontend.sequences import TRUTH, position_errors
from maplab_py.algorithms.keyframing.options import KeyframingOptions
from maplab_py.algorithms.loop_closure.workflow import close_loops
from maplab_py.algorithms.summary.options import SummaryMapOptions
from maplab_py.algorithms.summary.summary import make_summary_map
from maplab_py.algorithms.summary.workflow import WorkflowOptions, make_localization_map
from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.array_types import F64
from maplab_py.frontend.localization.options import OnlineLocalizationOptions
from maplab_py.frontend.mapping import Mapping
from maplab_py.frontend.run_options import OutputOptions, RunOptions
from maplab_py.geometry import se3
from maplab_py.geometry.alignment import umeyama
from maplab_py.geometry.interpolation import interpolate_poses
from maplab_py.interop.recordings.options import SourceOptions, StreamOptions
from maplab_py.interop.recordings.protocol import Recording
from maplab_py.interop.recordings.reader_choice import open_recording
from maplab_py.interop.trajectories import Trajectory, read_trajectory
from maplab_py.storage.summary_map import write_summary_map
from tests.support.data import shared_data_folder

_MAX_GAP_NS = 100_000_000


@dataclasses.dataclass(frozen=True)
class Flight:
    """A part of a recording with ground truth."""

    folder: Path
    stream: StreamOptions = StreamOptions()
    keyframing: KeyframingOptions = KeyframingOptions()

    def recording(self, cameras: str) -> Recording:
        """Open it with some cameras; "" = all."""
        return open_recording(self.folder, SourceOptions(rovio_active_camera_indices=cameras))

    @property
    def truth(self) -> Trajectory:
        """Its ground truth."""
        return read_trajectory(self.folder / TRUTH)


def flights(folder: Path | None) -> tuple[Flight, Flight]:
    """Return the flight that makes the map, and the one that is localised."""
    if folder is not None:
        return Flight(folder / "raw" / "session_1"), Flight(folder / "raw" / "session_2")
    recorded = shared_data_folder() / "euroc_mh01_10s"
    half_s = 5.0
    return (
        Flight(recorded, StreamOptions(end_s=half_s), KeyframingOptions(every_nth_vertex=1)),
        Flight(recorded, StreamOptions(start_s=half_s)),
    )


@dataclasses.dataclass(frozen=True)
class ImageErrors:
    """Errors and processor times of a flight with some cameras."""

    cameras: int
    odometry_rmse_m: float
    localized_rmse_m: float
    localized_median_m: float
    localized_share: float
    batch_rmse_m: float
    odometry_frame_ms: float  # processor time of a whole frame, median
    localized_frame_ms: float
    localized_frame_p99_ms: float

    @property
    def localized_ratio(self) -> float:
        """Localised / odometry, RMSE."""
        return self.localized_rmse_m / self.odometry_rmse_m

    @property
    def batch_ratio(self) -> float:
        """Batch / odometry, RMSE."""
        return self.batch_rmse_m / self.odometry_rmse_m


def make_map(flight: Flight, cameras: str, target: Path) -> F64:
    """Write the summary map of a flight; return T_G_R (7,), by the vertices of the map."""
    mapping = Mapping(flight.recording(cameras), RunOptions(stream=flight.stream))
    mapping.run()
    assert mapping.builder is not None
    options = WorkflowOptions(keyframing=flight.keyframing)
    vi_map, _ = make_localization_map(mapping.builder.finish()[0], options)
    write_summary_map(make_summary_map(vi_map, SummaryMapOptions()), target, overwrite=True)
    truth = flight.truth
    T_R_I, known = interpolate_poses(
        truth.times_ns, truth.T_R_B, vi_map.vertices.timestamp_ns, max_gap_ns=_MAX_GAP_NS
    )
    return umeyama(vi_map.T_G_I[known, 4:], T_R_I[known, 4:])[0]


def without_map(flight: Flight, cameras: str) -> tuple[float, float, float]:
    """Return the RMSE of the odometry and of the batch [m], and the median time of a frame [ms]."""
    times = FrameWatch()
    mapping = Mapping(flight.recording(cameras), RunOptions(stream=flight.stream), observer=times)
    mapping.run()
    truth, online = flight.truth, mapping.trajectory()
    assert mapping.builder is not None
    closed, _ = close_loops(mapping.builder.finish()[0])
    batch, _ = optimize(closed, VIOptimizationOptions())
    errors = (
        position_errors(truth, online.times_ns, online.T_R_B)[0],
        position_errors(truth, batch.vertices.timestamp_ns, batch.T_G_I)[0],
    )
    return _rms(errors[0]), _rms(errors[1]), float(np.median(times.spent_ms))


def with_map(
    flight: Flight, cameras: str, map_folder: Path, T_G_R: F64
) -> tuple[F64, float, FrameWatch]:
    """Return position errors of the localised frames (N,), their share, and times; without a map builder."""
    times = FrameWatch()
    localization = OnlineLocalizationOptions(map_folder=map_folder)
    output = OutputOptions(run_map_builder=False)
    options = RunOptions(localization=localization, output=output, stream=flight.stream)
    mapping = Mapping(flight.recording(cameras), options, observer=times)
    mapping.run()
    assert mapping.localization is not None
    times_ns, values = mapping.localized.columns
    is_localized = values[:, -2] == 1.0
    truth = flight.truth
    T_R_I, known = interpolate_poses(
        truth.times_ns, truth.T_R_B, times_ns[is_localized], max_gap_ns=_MAX_GAP_NS
    )
    p_G = se3.compose(T_G_R, T_R_I[known])[:, 4:]
    error = np.linalg.norm(values[is_localized][known, :3] - p_G, axis=1)
    return error, len(error) / mapping.statistics.frames, times


def measure(folder: Path | None, cameras: str, work: Path) -> ImageErrors:
    """Run both flights with some cameras; "" = all."""
    first, second = flights(folder)
    target = work / f"map_{cameras or 'all'}"
    T_G_R = make_map(first, cameras, target)
    error, share, times = with_map(second, cameras, target, T_G_R)
    odometry, batch, odometry_ms = without_map(second, cameras)
    return ImageErrors(
        cameras=len(second.recording(cameras).device.cameras),
        odometry_rmse_m=odometry,
        localized_rmse_m=_rms(error),
        localized_median_m=float(np.median(error)),
        localized_share=share,
        batch_rmse_m=batch,
        odometry_frame_ms=odometry_ms,
        localized_frame_ms=float(np.median(times.spent_ms)),
        localized_frame_p99_ms=float(np.percentile(times.spent_ms, 99.0)),
    )


def _rms(errors: F64) -> float:
    return float(np.sqrt(np.mean(errors**2)))
