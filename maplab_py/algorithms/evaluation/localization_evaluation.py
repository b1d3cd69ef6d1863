"""Poses in a map against ground truth, without aligning them: they claim to be in the map's frame."""

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.algorithms.evaluation.reports import LocalizationErrors
from maplab_py.array_types import F64, I64
from maplab_py.errors import EstimationError
from maplab_py.geometry import alignment, interpolation, se3
from maplab_py.interop import text_table, trajectories
from maplab_py.vimap import VIMap

_MAX_GAP_NS = 500_000_000
_MIN_PAIRS = 3


@dataclasses.dataclass(frozen=True, eq=False)
class LocalizedTrajectory:
    """Frames of a file, those included that were not localised."""

    name: str
    times_ns: I64  # (N,)
    T_G_I: F64  # (N, 7)
    is_localized: np.ndarray  # (N,)
    has_orientation: bool = True


def read_localized(path: Path) -> LocalizedTrajectory:
    """Read the file of `rovioli --export_localized_poses_to_csv`, or any trajectory in G.

    Raises:
        MapError: The file cannot be read or is not a trajectory.
    """
    table = text_table.read_text_table(path)
    trajectory, rows = trajectories.trajectory_of_table(table)
    is_localized = np.ones(len(trajectory), dtype=np.bool_)
    if trajectories.LOCALIZED in table.header:
        is_localized = table.values[rows, table.header.index(trajectories.LOCALIZED) - 1] > 0.0
    return LocalizedTrajectory(
        str(path),
        trajectory.times_ns,
        trajectory.T_R_B,
        is_localized,
        trajectory.has_orientation,
    )


def alignment_of_map(vi_map: VIMap, truth: trajectories.Trajectory) -> F64:
    """Return T_R_G (7,) that puts the vertices of a map where the ground truth has them.

    Raises:
        EstimationError: Fewer than three vertices lie in the span of the truth.
    """
    poses, inside = interpolation.interpolate_poses(
        truth.times_ns, truth.T_R_B, vi_map.vertices.timestamp_ns, max_gap_ns=_MAX_GAP_NS
    )
    if np.count_nonzero(inside) < _MIN_PAIRS:
        raise EstimationError(
            f"{truth.source}: fewer than {_MIN_PAIRS} vertices of the map lie in its time span: give "
            "the ground truth of the recordings that the map was made of"
        )
    T_R_G, _ = alignment.umeyama(poses[inside, 4:], vi_map.T_G_I[inside, 4:])
    return T_R_G


def localization_errors(
    localized: LocalizedTrajectory, truth: trajectories.Trajectory, T_R_G: F64
) -> LocalizationErrors:
    """Compare the frames of a file with ground truth in a frame R.

    Args:
        localized: Poses in G.
        truth: Ground truth in R.
        T_R_G: Pose (7,) of the map in R.

    Raises:
        EstimationError: No frame lies in the span of the truth.
    """
    poses, known = interpolation.interpolate_poses(
        truth.times_ns, truth.T_R_B, localized.times_ns, max_gap_ns=_MAX_GAP_NS
    )
    if not known.any():
        raise EstimationError(f"{localized.name}: no frame lies in the time span of {truth.source}")
    used = known & localized.is_localized
    frames, share = int(known.sum()), float(used.sum() / known.sum())
    if not used.any():
        return LocalizationErrors(localized.name, frames, 0.0, *([None] * 8))
    delta = se3.local(poses[used], se3.compose(T_R_G, localized.T_G_I[used]))
    error = np.linalg.norm(delta[:, :3], axis=1)
    step = np.linalg.norm(np.diff(delta[:, :3], axis=0), axis=1)
    first_s = float(localized.times_ns[used][0] - localized.times_ns[0]) * 1e-9
    return LocalizationErrors(
        file=localized.name,
        frames=frames,
        localized_share=share,
        first_localized_s=first_s,
        median_m=float(np.median(error)),
        std_m=float(np.std(error)),
        rmse_m=float(np.sqrt(np.mean(error**2))),
        largest_m=float(error.max()),
        median_deg=float(np.degrees(np.median(np.linalg.norm(delta[:, 3:], axis=1))))
        if truth.has_orientation and localized.has_orientation
        else None,
        largest_step_m=float(step.max()) if len(step) else None,
        median_step_m=float(np.median(step)) if len(step) else None,
    )
