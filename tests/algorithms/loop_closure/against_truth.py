"""Closures of simulated sessions against the truth: precision, recall, and how noisy bits were."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.loop_closure.closure_table import Closures
from maplab_py.geometry import se3
from maplab_py.simulation.evaluation import sightings
from maplab_py.simulation.scenario import Scenario
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import SimulatedData, simulate
from maplab_py.simulation.truth import Truth
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import IdIndex
from maplab_py.vimap.merge import merge_maps

_WRONG_M, _WRONG_DEG = 0.5, 5.0
_COMMON_LANDMARKS = 20


def without_noise(scenario: Scenario, vanish: float) -> Scenario:
    """Return a scenario whose only noise of descriptors is flipped bits; see `flip`."""
    appearance = dataclasses.replace(
        scenario.appearance,
        bit_noise=0.0,
        viewpoint_change=0.0,
        scale_change=0.0,
        session_change=0.0,
        vanish_share=vanish,
    )
    return dataclasses.replace(scenario, appearance=appearance)


def flip(vi_map: VIMap, share: float, seed: int) -> VIMap:
    """Return the map with some of all bits flipped, each by itself."""
    rng = np.random.default_rng(seed)
    descriptor = vi_map.keypoints.descriptor
    mask = np.packbits(rng.random((len(descriptor), 8 * descriptor.shape[1])) < share, axis=1)
    size = vi_map.binary_descriptor_size
    mask[np.arange(descriptor.shape[1])[None] >= size[:, None]] = 0
    return vi_map.replace(keypoints=vi_map.keypoints.replace(descriptor=descriptor ^ mask))


def sessions(
    flips: float, vanish: float, *, seed: int, rate_hz: float, duration_s: float | None = None
) -> tuple[VIMap, Truth]:
    """Return the four sessions in one map, base frames unknown, and the truth."""
    scenario = without_noise(load_scenario("four_sessions").with_seed(seed), vanish)
    measurement = dataclasses.replace(scenario.measurement, frame_rate_hz=rate_hz)
    scenario = dataclasses.replace(scenario, measurement=measurement)
    if duration_s is not None:
        parts = tuple(
            dataclasses.replace(s, duration_s=duration_s, turns=s.turns * duration_s / s.duration_s)
            for s in scenario.sessions
        )
        scenario = dataclasses.replace(scenario, sessions=parts)
    data = simulate(scenario)
    return flip(joined(data), flips, seed), data.truth


def joined(data: SimulatedData) -> VIMap:
    """Return all sessions in one map."""
    vi_map = data.maps[0]
    for other in data.maps[1:]:
        vi_map, _ = merge_maps(vi_map, other)
    return vi_map


def is_right(vi_map: VIMap, truth: Truth, closures: Closures) -> NDArray[np.bool_]:
    """Tell which closures (N,) are as true as 0.5 m and 5 degrees."""
    row = IdIndex(truth.vertex_id).rows(vi_map.vertices.id)
    true = se3.relative(
        truth.T_G_I[row[closures.query_vertex]], truth.T_G_I[row[closures.place_vertex]]
    )
    error = se3.local(true, closures.T_A_B)
    turn_deg = np.degrees(np.linalg.norm(error[:, 3:], axis=1))
    return np.asarray((np.linalg.norm(error[:, :3], axis=1) < _WRONG_M) & (turn_deg < _WRONG_DEG))


def closable(vi_map: VIMap, truth: Truth, min_time_s: float = 10.0) -> NDArray[np.bool_]:
    """Tell which vertices (V,) see 20 points that another vertex sees, apart in time or mission."""
    from scipy.sparse import csr_array

    seen = sightings(vi_map, truth)
    observing = vi_map.keypoints.landmark >= 0
    vertex = vi_map.keypoint_vertex[observing]
    real = seen.point >= 0
    shape = (len(vi_map.vertices), len(truth.point_G))
    ones = np.ones(int(real.sum()), dtype=np.int32)
    sees = csr_array((ones, (vertex[real], seen.point[real])), shape=shape)
    sees.sum_duplicates()
    sees.data[:] = 1
    common = (sees @ sees.T).tocoo()
    row, column = common.coords
    v = vi_map.vertices
    apart = np.abs(v.timestamp_ns[row] - v.timestamp_ns[column]) >= min_time_s * 1e9
    counts = (common.data >= _COMMON_LANDMARKS) & (apart | (v.mission[row] != v.mission[column]))
    result = np.zeros(len(v), dtype=np.bool_)
    result[row[counts]] = True
    return result


@dataclasses.dataclass(frozen=True)
class Score:
    """How good the accepted closures are."""

    accepted: int
    precision: float
    recall: float  # of vertices that could be closed
    closable: int


def score(vi_map: VIMap, truth: Truth, closures: Closures) -> Score:
    """Compare closures with the truth."""
    accepted = closures.accepted
    right = accepted & is_right(vi_map, truth, closures)
    found = np.zeros(len(vi_map.vertices), dtype=np.bool_)
    found[closures.query_vertex[right]] = True
    wanted = closable(vi_map, truth)
    return Score(
        int(accepted.sum()),
        float(right.sum() / max(accepted.sum(), 1)),
        float(np.mean(found[wanted])),
        int(wanted.sum()),
    )
