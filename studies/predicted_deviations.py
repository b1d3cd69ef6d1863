"""Predicted deviations of selections of segments, from the Jacobians at the true states.

Nothing is estimated. Selections that score each segment alone are compared with designs that add
segments greedily to minimise the joint covariance.
"""

import sys
from pathlib import Path

import numpy as np

from maplab_py.algorithms.self_calibration.segments.selection import evaluate
from maplab_py.algorithms.self_calibration.segments.splitting import extract_submap
from maplab_py.algorithms.self_calibration.uncertainty import posterior_covariance
from maplab_py.array_types import F64
from maplab_py.geometry import so3
from maplab_py.simulation.scenario import Scenario
from maplab_py.simulation.truth import true_map
from maplab_py.vimap import VIMap
from studies.data_sets import OPTIONS, append_line, data_set, lines_of, problem_of
from studies.published import levels
from studies.selections import FEW, WHOLE, joint_designs, random_choice, rankings


def predict(scenario: Scenario, sets: range, out: Path) -> None:
    """Append the predicted deviations of every selection for every data set."""
    done = {row["set"] for row in lines_of(out)}
    for number in sets:
        if number in done:
            continue
        data = data_set(scenario, number)
        true = true_map(data.maps[0], data.truth)
        evaluation = evaluate(true, OPTIONS)
        ranked = rankings(evaluate(data.maps[0], OPTIONS), "a_optimality", WHOLE)[0]
        count = min(FEW, len(ranked))
        selections: dict[str, list[int]] = {
            "batch": [],
            "8: A-optimality": ranked[:count],
            "8: random": random_choice(evaluation, number, count),
            **joint_designs(evaluation, levels(evaluation.parameters.names)),
        }
        for name, chosen in selections.items():
            rows = [evaluation.segments[k].rows for k in chosen]
            submap = extract_submap(true, np.unique(np.concatenate(rows))) if chosen else true
            names, sigma = _deviations(submap)
            row = {"set": number, "selection": name, "names": names, "sigma": sigma.tolist()}
            append_line(out, {**row, "segments": len(chosen), "tilt_deg": _tilt_deg(true)})
            error = float(np.sqrt(np.mean((sigma / levels(names)) ** 2)))
            sys.stdout.write(
                f"{number:3d} {name:32s} {error:6.2f} of the deviations of table 6.1\n"
            )
            sys.stdout.flush()


def _deviations(vi_map: VIMap) -> tuple[list[str], F64]:
    """Return the parameters' names and their deviations (k,) given a map and weak priors."""
    problem = problem_of(vi_map)
    covariance = posterior_covariance(problem, problem.states)
    return list(problem.parameters.names), np.asarray(np.sqrt(np.diag(covariance)))


def _tilt_deg(vi_map: VIMap) -> float:
    """Return the root mean square angle [deg] of gravity in the IMU frame about its mean."""
    down = so3.rotate(so3.inverse(vi_map.T_G_I[:, :4]), np.array([0.0, 0.0, -1.0]))
    mean = down.mean(axis=0) / np.linalg.norm(down.mean(axis=0))
    angle = np.arccos(np.clip(down @ mean, -1.0, 1.0))
    return float(np.rad2deg(np.sqrt(np.mean(angle**2))))
