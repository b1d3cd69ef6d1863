"""Table 4.1 of the thesis on simulated features: six flights make the map, a vehicle is localised in it."""

import dataclasses
import functools

import numpy as np

from maplab_py.algorithms.sparsification.options import SparsificationOptions
from maplab_py.algorithms.sparsification.sparsify import sparsify
from maplab_py.algorithms.summary.options import SummaryMapOptions
from maplab_py.algorithms.summary.summary import make_summary_map
from maplab_py.algorithms.summary.workflow import WorkflowOptions, make_localization_map
from maplab_py.array_types import F64, I64
from maplab_py.frontend.localization.map_source import SearchedMap, of_summary
from maplab_py.geometry import se3
from maplab_py.geometry.alignment import umeyama
from maplab_py.interop.trajectories import Trajectory
from maplab_py.simulation.scenario import (
    CameraOptions,
    MeasurementOptions,
    Scenario,
    SessionOptions,
    WorldOptions,
)
from maplab_py.simulation.simulate import simulate
from maplab_py.simulation.truth import true_map
from maplab_py.storage.summary_map import SummaryMap
from maplab_py.vimap import LandmarkQuality, VIMap
from maplab_py.vimap.ids import IdIndex
from maplab_py.vimap.merge import merge_maps

SHARES = (0.5, 0.25, 0.15, 0.05, 0.025)


@dataclasses.dataclass(frozen=True, eq=False)
class Setting:
    """A map with all its landmarks, a session to be localised, and the truth."""

    vi_map: VIMap
    query: VIMap
    start: Trajectory  # truth of the query in its mission frame
    times_ns: I64  # (V,) of the query's vertices
    T_R_I: F64  # (V, 7) their true poses in the world R
    vertex_id: np.ndarray  # (W, 2) of all sessions' vertices
    p_R: F64  # (W, 3) where they truly were

    @property
    def landmarks(self) -> int:
        """Number of good landmarks."""
        return int(np.count_nonzero(self.vi_map.landmarks.quality == LandmarkQuality.GOOD))

    def summary(self, share: float) -> SummaryMap:
        """Return the summary map with a share of the good landmarks, covariances included."""
        keep = round(share * self.landmarks)
        sparse, _, _ = sparsify(self.vi_map, keep, SparsificationOptions())
        return make_summary_map(sparse, SummaryMapOptions(covariances=True))

    def truth_in_map(self, summary: SummaryMap) -> F64:
        """Return the query's true poses (V, 7) in G: the map is aligned once, by its own vertices."""
        assert summary.observer_id is not None
        row = IdIndex(self.vertex_id).rows(summary.observer_id)
        known = row >= 0
        T_G_R, _ = umeyama(summary.p_G_observer[known], self.p_R[row[known]])
        return se3.compose(T_G_R, self.T_R_I)


def scenario(seed: int, *, duration_s: float, landmarks: int, rate_hz: float) -> Scenario:
    """Return six flights through a room and a vehicle with another device at another height."""
    flights = tuple(
        SessionOptions(
            kind=kind, duration_s=duration_s, turns=0.03 * duration_s, start_turn=start,
            reverse=reverse, height_m=height,
        )
        for kind, start, reverse, height in (
            ("room_scan", 0.0, False, 1.6), ("figure_8", 0.0, False, 1.4),
            ("room_scan", 0.5, True, 2.0), ("loop", 0.0, False, 1.2),
            ("room_scan", 0.25, False, 1.3), ("loop", 0.5, True, 1.8),
        )
    )  # fmt: skip
    vehicle = SessionOptions(
        kind="vehicle",
        duration_s=1.5 * duration_s,
        turns=0.045 * duration_s,
        height_m=0.6,
        device=1,
    )
    return Scenario(
        name="online localisation",
        world=WorldOptions(room_size_m=(12.0, 9.0, 3.5), landmarks_per_room=landmarks),
        cameras=(CameraOptions(),),
        measurement=MeasurementOptions(frame_rate_hz=rate_hz, max_keypoints=400),
        sessions=(*flights, vehicle),
    ).with_seed(seed)


def setting(
    seed: int, *, duration_s: float = 30.0, landmarks: int = 10_000, rate_hz: float = 10.0
) -> Setting:
    """Simulate, and make the map of the flights as users do."""
    options = scenario(seed, duration_s=duration_s, landmarks=landmarks, rate_hz=rate_hz)
    data = simulate(options)
    merged = functools.reduce(lambda a, b: merge_maps(a, b)[0], data.maps[:-1])
    vi_map, _ = make_localization_map(merged, WorkflowOptions())
    query = data.maps[-1]
    truth = true_map(query, data.truth)
    v = truth.vertices
    start = Trajectory(v.timestamp_ns, v.T_M_I, v.v_M, v.gyro_bias, v.accel_bias)
    row = IdIndex(data.truth.vertex_id).rows(query.vertices.id)
    return Setting(
        vi_map, query, start, query.vertices.timestamp_ns, data.truth.T_G_I[row],
        data.truth.vertex_id, data.truth.T_G_I[:, 4:],
    )  # fmt: skip


def searched(summary: SummaryMap, share: float, *, with_covariances: bool = False) -> SearchedMap:
    """Return the map that is searched."""
    return of_summary(summary, f"{100 * share:g} %", with_covariances=with_covariances)
