"""Say how certain selections of segments of simulated sessions could make the calibration at best.

python docs/scripts/announce_self_calibration.py --sets=3 --out=navigation_announced.jsonl

Nothing is estimated: deviations follow from the Jacobians at the true states. Beside the selections of
evaluate_self_calibration.py there are designs that know better than to judge each segment by itself:
eight segments taken one after the other so that all of them together are as certain as possible.
Appends one line per data set and selection, and goes on where it stopped.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from evaluate_self_calibration import (
    F64,
    FEW,
    OPTIONS,
    WHOLE,
    append_line,
    data_set,
    lines_of,
    scores_of,
)
from self_calibration_page import levels

from maplab_py.algorithms.self_calibration.collection import Evaluation, evaluate
from maplab_py.algorithms.self_calibration.information import posterior_covariance
from maplab_py.algorithms.self_calibration.problem import pose
from maplab_py.algorithms.self_calibration.segments import restricted
from maplab_py.geometry import so3
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.true_map import true_map
from maplab_py.vimap import VIMap


def sigma_of(vi_map: VIMap) -> tuple[list[str], F64]:
    """Return the parameters' names and their deviations (k,) given all of a map, weakly known before."""
    problem = pose(vi_map, OPTIONS, robust=False)
    covariance = posterior_covariance(problem, problem.posed.states)
    return list(problem.parameters.names), np.sqrt(np.diag(covariance))


def greedy(information: list[F64], prior: F64, loss: Callable[[F64], float]) -> list[int]:
    """Return segments whose information (k, k) adds up to the least loss of the covariance."""
    chosen: list[int] = []
    total = prior
    for _ in range(min(FEW, len(information))):
        losses = [loss(np.linalg.inv(total + one)) for one in information]
        losses = [np.inf if k in chosen else value for k, value in enumerate(losses)]
        chosen.append(int(np.argmin(losses)))
        total = total + information[chosen[-1]]
    return chosen


def designs(evaluation: Evaluation) -> dict[str, list[int]]:
    """Return segments that were chosen for what they tell together."""
    parameters = evaluation.parameters
    names = list(parameters.names)
    prior = np.diag(parameters.prior_sigma**-2.0)
    own = [np.linalg.inv(one.covariance) - prior for one in evaluation.segments]
    scales = [n.startswith("accelerometer") and n.endswith("scale") for n in names]

    def trace(unit: F64) -> Callable[[F64], float]:
        return lambda covariance: float(np.sum(np.diag(covariance) / unit**2))

    losses: dict[str, Callable[[F64], float]] = {
        "thesis' deviations": trace(levels(names)),
        "usual deviations": trace(evaluation.sigma_ref()),
        "determinant": lambda covariance: float(np.linalg.slogdet(covariance)[1]),
        "accelerometer scale": lambda covariance: float(covariance[np.ix_(scales, scales)].sum()),
    }
    return {f"8 together, {name}": greedy(own, prior, loss) for name, loss in losses.items()}


def tilt_deg(vi_map: VIMap) -> float:
    """Return how far [deg] gravity turned as the IMU saw it, root mean square about its mean."""
    down = so3.rotate(so3.inverse(vi_map.T_G_I[:, :4]), np.array([0.0, 0.0, -1.0]))
    mean = down.mean(axis=0) / np.linalg.norm(down.mean(axis=0))
    angle = np.arccos(np.clip(down @ mean, -1.0, 1.0))
    return float(np.rad2deg(np.sqrt(np.mean(angle**2))))


def announce(scenario_name: str, sets: range, out: Path) -> None:
    """Append the deviations of every selection."""
    scenario = load_scenario(scenario_name)
    done = {row["set"] for row in lines_of(out)}
    for number in sets:
        if number in done:
            continue
        data = data_set(scenario, number)
        vi_map = data.maps[0]
        true = true_map(vi_map, data.truth)
        evaluation = evaluate(true, OPTIONS)
        rng = np.random.default_rng(number)
        score = scores_of(evaluate(vi_map, OPTIONS), "a_optimality", WHOLE)[WHOLE]
        selections: dict[str, list[int]] = {
            "batch": [],
            "8: A-optimality": np.argsort(score, kind="stable")[:FEW].tolist(),
            "8: random": rng.choice(len(score), size=FEW, replace=False).tolist(),
            **designs(evaluation),
        }
        for name, chosen in selections.items():
            rows = [evaluation.segments[k].rows for k in chosen]
            small = restricted(true, np.unique(np.concatenate(rows))) if chosen else true
            names, sigma = sigma_of(small)
            row = {"set": number, "selection": name, "names": names, "sigma": sigma.tolist()}
            append_line(out, {**row, "segments": len(chosen), "tilt_deg": tilt_deg(true)})
            error = float(np.sqrt(np.mean((sigma / levels(names)) ** 2)))
            sys.stdout.write(f"{number:3d} {name:32s} {error:6.2f} of the thesis' deviations\n")
            sys.stdout.flush()


def main() -> int:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", default="navigation")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--sets", type=int, default=3)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    sets = range(arguments.first, arguments.first + arguments.sets)
    announce(arguments.scenario, sets, arguments.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
