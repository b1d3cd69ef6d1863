"""The eight EuRoC submaps as missions in scrambled base frames, put together again."""

import dataclasses
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from maplab_py.console.commands.registry import load_registry
from maplab_py.console.session.session import Session
from maplab_py.geometry import yaw
from maplab_py.vimap import VIMap
from tests.e2e.test_real_workflows import C_TRUTH, O_TRUTH, SUBMAPS, ape_m, scrambled
from tests.support.data import shared_data


@dataclasses.dataclass(frozen=True)
class ScrambledFigures:
    """What became of one scramble."""

    seed: int
    known: int  # the mission that was known
    anchored: int
    difference_m: float  # largest of the missions' middles from those of the first scramble
    end_error_m: float  # ATE after relax, lc and optvi against the shipped truth
    end_error_corrected_m: float  # and against the corrected one


def measure(seeds: list[int]) -> Iterator[ScrambledFigures]:
    """Scramble, anchor, relax, close and optimise, once for every seed."""
    session = Session(load_registry())
    session.run("load_merge_all_maps", maps_folder=shared_data(SUBMAPS), assign_new_ids=True)
    session.run("elq")
    session.run("optvi")
    before = session.maps.selected.vi_map
    reference: NDArray[np.float64] | None = None
    for seed in seeds:
        known = seed % len(before.missions)
        vi_map = scrambled(before, seed)
        flags = np.arange(len(vi_map.baseframes)) == vi_map.missions.baseframe[known]
        vi_map = vi_map.replace(baseframes=vi_map.baseframes.replace(is_known=flags))
        session.maps.update(session.maps.selected.with_value(vi_map, "scramble"))
        session.run("anchor_all_missions")
        anchored = session.maps.selected.vi_map
        middles = _middles(anchored)
        reference = middles if reference is None else reference
        for command in ("relax", "lc", "optvi"):
            session.run(command)
        yield ScrambledFigures(
            seed,
            known,
            int(anchored.baseframes.is_known.sum()),
            float(np.linalg.norm(middles - reference, axis=1).max()),
            ape_m(session, O_TRUTH).ape_m.rmse,
            ape_m(session, C_TRUTH).ape_m.rmse,
        )


def _middles(vi_map: VIMap) -> NDArray[np.float64]:
    """Return the middles of the missions (M, 3) in the frame of the first."""
    T_G_M = yaw.from_pose(vi_map.T_G_M)
    T_0_M = yaw.compose(yaw.inverse(T_G_M[:1]), T_G_M)
    mission = vi_map.vertices.mission
    return np.array(
        [
            yaw.transform(T_0_M[m], vi_map.vertices.T_M_I[mission == m, 4:].mean(axis=0))
            for m in range(len(vi_map.missions))
        ]
    )
