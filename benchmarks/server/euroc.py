"""EuRoC V1_01 as eight submaps of one robot, and as two robots with four each."""

import dataclasses

from benchmarks.server.prepared import prepared
from maplab_py.console.commands.registry import load_registry
from maplab_py.console.session.session import Session
from maplab_py.server.merging import Merger
from maplab_py.server.options import IncrementalOptions, MergingOptions
from maplab_py.storage.native import load_map
from maplab_py.vimap import VIMap, edits, excerpts
from tests.support.data import shared_data
from tests.support.submaps import append_submaps

O_TRUTH, C_TRUTH = "ground_truth/V1_01_easy.csv", "euroc_imu/V101.gt.csv"
SUBMAPS = 8
_SUBMAP_S = 19.0


@dataclasses.dataclass(frozen=True)
class EurocFigures:
    """Errors [m] against both truths."""

    robots: int
    missions: int
    anchored: int
    incremental_O_m: float
    incremental_C_m: float
    final_O_m: float  # after the joint optimisation at the end
    final_C_m: float


def submaps() -> list[VIMap]:
    """Return the submaps in the order of time."""
    folder = shared_data("maplab_maps/euroc_v1_01")
    return [load_map(folder / f"euroc_v1_01_submap_{k}")[0] for k in range(SUBMAPS)]


def of_two_robots() -> list[VIMap]:
    """Return them as two robots send them by turns: the second half has ids of its own."""
    every = submaps()
    second = edits.with_new_ids(append_submaps(every[SUBMAPS // 2 :])[0])
    halves = zip(every[: SUBMAPS // 2], excerpts.cut_by_time(second, _SUBMAP_S), strict=True)
    return [submap for pair in halves for submap in pair]


def measure_euroc(robots: int) -> EurocFigures:
    """Merge the submaps of one robot or two."""
    merger = Merger(MergingOptions(), IncrementalOptions())
    for submap in submaps() if robots == 1 else of_two_robots():
        merger.add(prepared(submap))
    incremental = errors_m(merger.vi_map)
    merger.optimize_jointly()
    vi_map = merger.vi_map
    assert vi_map is not None
    known = int(vi_map.baseframes.is_known.sum())
    return EurocFigures(robots, len(vi_map.missions), known, *incremental, *errors_m(vi_map))


def errors_m(vi_map: VIMap | None) -> tuple[float, float]:
    """Return the RMSE of positions against O and C."""
    assert vi_map is not None
    session = Session(load_registry())
    session.maps.add("merged", vi_map)
    o, c = (
        session.run("evaluate_trajectory", ground_truth=shared_data(truth), alignment="se3")
        for truth in (O_TRUTH, C_TRUTH)
    )
    return float(o.ape_m.rmse), float(c.ape_m.rmse)
