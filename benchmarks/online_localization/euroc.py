"""EuRoC V1_01: pieces of the flight are localised in a map of the other pieces.

The submaps have keyframes of 1 Hz with real descriptors, of one flight. A query starts at its recorded
state, in a mission frame that is moved and turned at random.
"""

import dataclasses
import functools
from pathlib import Path

import numpy as np

from benchmarks.online_localization.modes import MODES, Comparison, compare
from maplab_py.algorithms.keyframing.options import KeyframingOptions
from maplab_py.algorithms.summary.workflow import WorkflowOptions, make_localization_map
from maplab_py.array_types import F64
from maplab_py.frontend.localization.map_source import SearchedMap, of_map
from maplab_py.frontend.localization.options import OnlineLocalizationOptions
from maplab_py.frontend.odometry_options import OdometryOptions
from maplab_py.geometry import se3, so3
from maplab_py.geometry.alignment import umeyama
from maplab_py.geometry.interpolation import interpolate_poses
from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.interop.trajectories import Trajectory, read_trajectory
from maplab_py.storage.native import load_map
from maplab_py.vimap import VIMap
from maplab_py.vimap.merge import merge_maps
from tests.frontend.known_start import KnownStart

PIECES = 8
_GAP_NS = 200_000_000


def make_map(folder: Path, left_out: tuple[int, ...]) -> VIMap:
    """Return the localisation map of all pieces but some."""
    pieces = [
        load_map(folder / f"euroc_v1_01_submap_{number}")[0]
        for number in range(PIECES)
        if number not in left_out
    ]
    merged = functools.reduce(lambda a, b: merge_maps(a, b, assign_new_ids=True)[0], pieces)
    frames = merged.baseframes
    unknown = np.zeros(len(frames), dtype=np.bool_)
    merged = merged.replace(baseframes=frames.replace(is_known=unknown))
    options = WorkflowOptions(keyframing=KeyframingOptions(every_nth_vertex=1))
    return make_localization_map(merged, options)[0]


def alignment(vi_map: VIMap, truth: Trajectory) -> F64:
    """Return T_G_R (7,) by the vertices of the map."""
    poses, known = interpolate_poses(
        truth.times_ns, truth.T_R_B, vi_map.vertices.timestamp_ns, max_gap_ns=_GAP_NS
    )
    return umeyama(vi_map.T_G_I[known, 4:], poses[known, 4:])[0]


def scrambled_start(query: VIMap, seed: int) -> KnownStart:
    """Return the recorded states in a mission frame that is moved and turned about the vertical."""
    rng, v = np.random.default_rng(seed), query.vertices
    q = so3.exp([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    T_N_M = se3.make(q, rng.uniform(-5.0, 5.0, 3))
    return KnownStart(
        Trajectory(
            v.timestamp_ns, se3.compose(T_N_M, v.T_M_I), so3.rotate(q, v.v_M), v.gyro_bias,
            v.accel_bias,
        ),
        with_biases=True,
    )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class RealErrors:
    """Position errors of a mode over all queries, with the ground truth's own error."""

    frames: int
    localized_share: float
    median_m: float
    std_m: float
    rmse_m: float
    largest_m: float


def measure(
    folder: Path,
    truth_file: Path,
    options: OnlineLocalizationOptions,
    queries: tuple[tuple[int, ...], ...] = ((3, 6), (2, 5)),
    odometry_options: OdometryOptions | None = None,
) -> tuple[dict[str, RealErrors], list[Comparison]]:
    """Localise each piece in a map without it and its companion; return errors by mode."""
    truth = read_trajectory(truth_file)
    errors: dict[str, list[F64]] = {mode: [] for mode in MODES}
    frames, comparisons = 0, []
    for left_out in queries:
        vi_map = make_map(folder, left_out)
        searched: SearchedMap = of_map(
            vi_map, f"without {left_out}", with_covariances=options.rule.estimates_landmarks
        )
        T_G_R = alignment(vi_map, truth)
        for number in left_out:
            query, _ = load_map(folder / f"euroc_v1_01_submap_{number}")
            result = compare(
                MapRecording(query, 0), searched, options,
                make_starter=scrambled_start(query, number), odometry_options=odometry_options,
            )  # fmt: skip
            comparisons.append(result)
            frames += result.frames
            for mode in MODES:
                times_ns, T_G_I = result.results[mode].times_ns, result.results[mode].T_G_I
                if not len(times_ns):
                    continue
                poses, known = interpolate_poses(
                    truth.times_ns, truth.T_R_B, times_ns, max_gap_ns=_GAP_NS
                )
                where = se3.compose(T_G_R, poses[known])
                errors[mode].append(np.linalg.norm(where[:, 4:] - T_G_I[known, 4:], axis=1))
    return {mode: _summary(parts, frames) for mode, parts in errors.items()}, comparisons


def _summary(parts: list[F64], frames: int) -> RealErrors:
    error = np.concatenate(parts) if parts else np.full(1, np.nan)
    count = sum(len(part) for part in parts)
    return RealErrors(
        frames=frames,
        localized_share=count / max(frames, 1),
        median_m=float(np.median(error)),
        std_m=float(np.std(error)),
        rmse_m=float(np.sqrt(np.mean(error**2))),
        largest_m=float(error.max()),
    )
