"""Merged copies of the recorded hand-held map: loop closure and optimisation of many alike sessions.

`python -m benchmarks.map_copies [COPIES] [--solver auto|multifrontal|pcg]`

Copies come under new ids; poses are disturbed by 1 cm and 2 mrad, base frames by 5 cm and 5 mrad of yaw.
"""

import argparse

import numpy as np

from benchmarks.solution import effort
from maplab_py.console.commands.registry import load_registry
from maplab_py.console.session.session import Session
from maplab_py.geometry import se3, so3
from maplab_py.storage.map_loading import load_map
from maplab_py.vimap import VIMap, merge
from tests.support.data import shared_data

_TANGO = "maplab_maps/tango_handheld"


def copies(vi_map: VIMap, count: int, seed: int = 0) -> VIMap:
    """Return a map with a number of disturbed copies of a map's missions."""
    merged = vi_map
    for copy in range(1, count):
        disturbed = _disturbed(vi_map, np.random.default_rng([seed, copy]))
        merged, _ = merge.merge_maps(merged, disturbed, assign_new_ids=True)
    return merged


def _disturbed(vi_map: VIMap, rng: np.random.Generator) -> VIMap:
    """Return the map with other poses and base frames."""
    T_M_I = vi_map.vertices.T_M_I
    twist = np.concatenate(
        [rng.normal(0.0, 0.01, (len(T_M_I), 3)), rng.normal(0.0, 0.002, (len(T_M_I), 3))], axis=1
    )
    vertices = vi_map.vertices.replace(T_M_I=se3.retract(T_M_I, twist))
    T_G_M = vi_map.baseframes.T_G_M
    turn = np.zeros((len(T_G_M), 3))
    turn[:, 2] = rng.normal(0.0, 0.005, len(T_G_M))
    q = so3.multiply(so3.exp(turn), T_G_M[:, :4])
    p = T_G_M[:, 4:] + rng.normal(0.0, 0.05, (len(T_G_M), 3))
    baseframes = vi_map.baseframes.replace(T_G_M=np.concatenate([q, p], axis=1))
    return vi_map.replace(vertices=vertices, baseframes=baseframes)


def main() -> None:
    """Merge, close, optimise and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("copies", type=int, nargs="?", default=8)
    parser.add_argument("--solver", default="auto")
    parser.add_argument("--iterations", type=int, default=5)
    arguments = parser.parse_args()
    session = Session(load_registry())
    vi_map, _ = load_map(shared_data(_TANGO))
    session.maps.add("single", vi_map)
    session.run("optvi", ba_num_iterations=1)  # loads compiled kernels
    session.maps.remove("single")
    session.maps.add("copies", copies(vi_map, arguments.copies))
    del vi_map
    for command, flags in (
        ("lc", {}),
        (
            "optvi",
            {
                "ba_num_iterations": arguments.iterations,
                "ba_linear_solver_type": arguments.solver,
                "ba_function_tolerance": 0.0,
            },
        ),
    ):
        with effort() as spent:
            report = session.run(command, **flags)
        print(
            f"{command}: {spent.user_s + spent.system_s:.1f} s processor, {spent.wall_s:.1f} s, "
            f"memory grew by {spent.peak_growth_mb:.0f} MB"
        )
        print(report)


if __name__ == "__main__":
    main()
