"""Gain of suggested motions over random ones.

python -m benchmarks.suggested_motions [--seeds=3] [--first_seed=1]

A device has recorded eight seconds that excite it poorly. The first three motions of `suggest_motion` are
simulated in another room with other noise and added, or three random segments of a session with rest, turns
and lively motion (median of 200 draws). A line a case and seed: how many times smaller the deviation of the
parameter that is known least becomes.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np

from maplab_py.algorithms.self_calibration.changes import joint_covariance
from maplab_py.algorithms.self_calibration.segments.selection import collect, evaluate
from maplab_py.array_types import F64
from maplab_py.online_calibration.options import WantedSigmas
from maplab_py.online_calibration.process import OPTIONS
from maplab_py.online_calibration.suggestions import (
    MOTIONS,
    simulated_segment,
    suggest_motion,
    wanted_sigma,
)
from maplab_py.simulation.scenario import MotionOptions
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from studies.data_sets import data_set
from tests.online_calibration.recorded import device_scenario

POOR = {
    "straight": MotionOptions(kind="straight", duration_s=8.1, speed_mps=0.3),
    "standing": MotionOptions(kind="stationary", duration_s=8.1),
    "turning on the spot": MotionOptions(kind="rotation", duration_s=8.1, turns=0.4),
    "calm walk": MotionOptions(
        kind="room_scan", duration_s=8.1, turns=0.13, height_m=1.4, shake_m=0.004, shake_rad=0.015
    ),
    "turns about one axis": MotionOptions(kind="figure_8", duration_s=8.1, turns=0.2, height_m=1.4),
}
_DRAWS = 200


def gains(phase: MotionOptions, seed: int, everyday: Sequence[F64]) -> tuple[str, float, float]:
    """Return the least known parameter, and the gains by suggested and by random segments."""
    vi_map = simulate(device_scenario(phase, seed=seed)).maps[0]
    database, _ = collect(vi_map, OPTIONS)
    report = suggest_motion(database, OPTIONS, WantedSigmas())
    evaluation = evaluate(database.vi_map, OPTIONS)
    prior = evaluation.parameters.prior_sigma
    tolerance = wanted_sigma(database.vi_map, OPTIONS, WantedSigmas())
    known = [segment.covariance for segment in evaluation.segments]
    before = np.diag(joint_covariance(known, prior))
    worst = int(np.argmax(before / tolerance**2))

    def gain(more: Sequence[F64]) -> float:
        return float(
            np.sqrt(before[worst] / joint_covariance([*known, *more], prior)[worst, worst])
        )

    by_words = {motion.words: motion for motion in MOTIONS}
    suggested = [
        evaluate(
            simulated_segment(database.vi_map.sensors, by_words[each.motion], seed=100 + seed), OPTIONS
        ).segments[0].covariance
        for each in report.suggestions
    ]  # fmt: skip
    rng = np.random.default_rng(seed)
    draws = [
        gain([everyday[row] for row in rng.choice(len(everyday), 3, replace=False)])
        for _ in range(_DRAWS)
    ]
    return evaluation.parameters.names[worst], gain(suggested), float(np.median(draws))


def main() -> None:
    """Print a line a case and seed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first_seed", type=int, default=1)
    arguments = parser.parse_args()
    counts = [0, 0]
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds):
        plain = device_scenario(*load_scenario("ar_room").sessions[0].phases, seed=seed)
        session = evaluate(data_set(plain, 0).maps[0], OPTIONS)
        everyday = [segment.covariance for segment in session.segments]
        for case, phase in POOR.items():
            name, suggested, by_chance = gains(phase, seed, everyday)
            good = suggested >= 3.0 and suggested >= 2.0 * by_chance
            counts = [counts[0] + good, counts[1] + 1]
            print(
                f"{'good' if good else 'BAD '} {case} {seed}: {name}: {suggested:.1f} times, random "
                f"{by_chance:.1f} ({suggested / by_chance:.1f})",
                flush=True,
            )
    print(f"good: {counts[0]} of {counts[1]}")


if __name__ == "__main__":
    main()
