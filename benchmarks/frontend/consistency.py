"""NEES of the fixed-lag smoother on simulated tracks: `python -m benchmarks.frontend.consistency`.

The normalised estimation error squared of position and of orientation, 3 degrees of freedom each, is 3
on average when the covariances are right, larger when they promise too much. The start has errors of
the deviations it states.
"""

import argparse
import dataclasses
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maplab_py.estimation.window.options import WindowOptions
from maplab_py.estimation.window.smoother import FixedLagSmoother
from maplab_py.geometry import se3
from tests.estimation.window.recordings import SimulatedTracks, scenario, simulated

START_SIGMA = np.repeat([1e-3, 2e-3, 0.02, 1e-3, 0.02], 3)


@dataclasses.dataclass(frozen=True)
class Consistency:
    """Means over the frames of a run."""

    nees_position: float
    nees_orientation: float
    nees_yaw: float  # 1 degree of freedom
    rmse_m: float
    end_error_m: float
    end_error_deg: float


def run(tracks: SimulatedTracks, options: WindowOptions, seed: int) -> Consistency:
    """Estimate a session and compare with the truth, the first second left out."""
    smoother = FixedLagSmoother(tracks.cameras, tracks.T_I_C, tracks.imu, options)
    start = tracks.start_state(START_SIGMA, np.random.default_rng([seed, 77]))
    smoother.start(tracks.frames[0], start)
    nees, errors = [], []
    for row, frame in enumerate(tracks.frames[1:], start=1):
        update = smoother.add(frame)
        error = se3.local(update.state.T_M_I[0], tracks.T_M_I[row])
        nees.append(_nees(error, update.covariance, update.state.T_M_I[0]))
        errors.append(error)
    later = slice(10, None)
    mean, error = np.mean(nees[later], axis=0), np.array(errors)
    return Consistency(
        *(float(x) for x in mean),
        rmse_m=float(np.sqrt(np.mean(np.sum(error[later, :3] ** 2, axis=1)))),
        end_error_m=float(np.linalg.norm(error[-1, :3])),
        end_error_deg=float(np.degrees(np.linalg.norm(error[-1, 3:]))),
    )


def _nees(
    error: NDArray[np.float64], covariance: NDArray[np.float64], T_M_I: NDArray[np.float64]
) -> tuple[float, float, float]:
    position = error[:3] @ np.linalg.solve(covariance[:3, :3], error[:3])
    turn = covariance[3:6, 3:6]
    orientation = error[3:] @ np.linalg.solve(turn, error[3:])
    up = se3.to_matrix(T_M_I)[2, :3]  # of M, in I
    yaw = float(up @ error[3:]) ** 2 / float(up @ turn @ up)
    return float(position), float(orientation), yaw


VARIANTS: dict[str, WindowOptions] = {
    "as it is": WindowOptions(),
    "policy of the thesis": WindowOptions(landmark_policy="thesis"),
}


def main() -> None:
    """Run all seeds; print means and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--rate", type=float, default=10.0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    results: dict[str, list[Consistency]] = {}
    for seed in range(1, arguments.seeds + 1):
        for stereo in (True, False):
            tracks = simulated(
                scenario(
                    seed=seed, duration_s=arguments.seconds, stereo=stereo, rate_hz=arguments.rate
                )
            )
            for name, options in VARIANTS.items():
                key = f"{'stereo' if stereo else 'mono'}, {name}"
                results.setdefault(key, []).append(run(tracks, options, seed))
                print(seed, key, dataclasses.asdict(results[key][-1]), flush=True)
    for key, values in results.items():
        table = np.array([dataclasses.astuple(value) for value in values])
        means = dict(zip(dataclasses.asdict(values[0]), table.mean(axis=0).round(4), strict=True))
        print(key, {name: float(value) for name, value in means.items()})
    if arguments.json:
        content = {key: [dataclasses.asdict(v) for v in values] for key, values in results.items()}
        arguments.json.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
