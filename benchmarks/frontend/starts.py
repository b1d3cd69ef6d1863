"""Starts in motion: `python -m benchmarks.frontend.starts [--imu recorded|simulated]`.

The initialisation is started every few seconds of flights along the ground truth of EuRoC's V1_01, V1_02
and MH_04, with both cameras and with the first alone. Tracks are simulated (0.8 px); IMU samples are
simulated or those recorded. Of every start: time from its first frame until the state is known, error of
the direction of gravity, scale of the flight from which the state was taken (by a similarity to the
truth), and of its last velocity, that is the component along the true one as a share of it. A velocity
below 0.3 m/s has no scale; its error counts as a share of 0.3 m/s. A start at rest has neither.
"""

import argparse
import dataclasses
import json
import shutil
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maplab_py.estimation.window.frame import StartState
from maplab_py.frontend.initialization.initializer import Initializer
from maplab_py.geometry import so3
from maplab_py.geometry.alignment import umeyama
from maplab_py.simulation.scenario import Scenario
from maplab_py.simulation.scenario_file import load_scenario
from tests.estimation.window.recordings import SimulatedTracks, simulated
from tests.support.data import REPOSITORY, shared_data_folder

F64 = NDArray[np.float64]
FLIGHTS = ("V101", "V102", "MH04")
_SCENARIOS = {"V101": "vicon_room", "V102": "vicon_room", "MH04": "machine_hall"}
_SLOW_MPS = 0.3
_PATIENCE_S = 15.0
"""A start that takes longer counts as failed."""


@dataclasses.dataclass(frozen=True)
class Start:
    """One start."""

    flight: str
    cameras: int
    begin_s: float  # of the flight
    seconds: float  # from its first frame to its first state; infinite = none
    tilt_deg: float
    speed_mps: float
    scale: float  # of the positions, estimated / true; NaN at rest
    velocity_scale: float  # estimated / true; NaN below 0.3 m/s
    velocity_error: float  # of the velocity in I, as a share of the speed
    waited_for: str  # reason of the last refusal


def flight(name: str, cameras: int, imu: str) -> SimulatedTracks:
    """Return the tracks of a flight, and its true states."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for file in (f"{name}.gt.csv", f"{name}.imu.csv"):
            shutil.copy(shared_data_folder() / "euroc_imu" / file, folder / file)
        return simulated(_scenario(name, cameras, folder, has_recorded_imu=imu == "recorded"))


def _scenario(name: str, cameras: int, folder: Path, *, has_recorded_imu: bool) -> Scenario:
    file = f"{_SCENARIOS[name]}.yaml"
    examples = REPOSITORY / "docs" / "examples" / "recorded_flights"
    text = (examples / file).read_text(encoding="utf-8")
    (folder / file).write_text(text.replace("V101.gt", f"{name}.gt"), encoding="utf-8")
    scenario = load_scenario(folder / file)
    session = dataclasses.replace(
        scenario.sessions[0],
        recorded_imu=str(folder / f"{name}.imu.csv") if has_recorded_imu else "",
    )
    return dataclasses.replace(
        scenario,
        cameras=scenario.cameras[:cameras],
        images=dataclasses.replace(scenario.images, render=False),
        sessions=(session,),
    )


def start(tracks: SimulatedTracks, name: str, begin_s: float) -> Start:
    """Start at some time of a flight."""
    count = len(tracks.cameras)
    initializer = Initializer(tracks.device)
    times_s = np.array([frame.time_ns - tracks.frames[0].time_ns for frame in tracks.frames]) * 1e-9
    reason = ""
    for row in np.flatnonzero((times_s >= begin_s) & (times_s <= begin_s + _PATIENCE_S)).tolist():
        found = initializer.push(tracks.frames[row])
        if found is not None:
            of_state = row - len(found.later)
            tilt, speed, *of_velocity = _errors(
                found.state, tracks.T_M_I[of_state], tracks.v_M[of_state]
            )
            scale = _scale(initializer, tracks)
            seconds = float(times_s[row]) - begin_s
            return Start(name, count, begin_s, seconds, tilt, speed, scale, *of_velocity, reason)
        reason = initializer.reason
    return Start(name, count, begin_s, np.inf, np.nan, np.nan, np.nan, np.nan, np.nan, reason)


def _scale(initializer: Initializer, tracks: SimulatedTracks) -> float:
    """Return how many times as long as the truth the flight is from which a state was taken."""
    attempt = initializer.attempt
    if attempt is None or attempt.state is None or attempt.refined is None:
        return np.nan
    rows = np.searchsorted([frame.time_ns for frame in tracks.frames], attempt.refined.time_ns)
    estimated = attempt.refined.states.T_M_I[:, 4:]
    return 1.0 / umeyama(tracks.T_M_I[rows, 4:], estimated, with_scale=True)[1]


def _errors(state: StartState, T_M_I: F64, v_M: F64) -> tuple[float, float, float, float]:
    """Return error of the tilt [deg], true speed [m/s], scale, and share of the velocity's error."""
    up = np.array([0.0, 0.0, 1.0])
    q_I_M, q_I_M_true = so3.inverse(state.T_M_I[0, :4]), so3.inverse(T_M_I[:4])
    chord = np.linalg.norm(so3.rotate(q_I_M, up) - so3.rotate(q_I_M_true, up))
    v, v_true = so3.rotate(q_I_M, state.v_M[0]), so3.rotate(q_I_M_true, v_M)
    speed = float(np.linalg.norm(v_true))
    return (
        float(np.degrees(2.0 * np.arcsin(0.5 * chord))),
        speed,
        float(v @ v_true) / speed**2 if speed >= _SLOW_MPS else np.nan,
        float(np.linalg.norm(v - v_true)) / max(speed, _SLOW_MPS),
    )


def summary(starts: list[Start]) -> dict[str, float]:
    """Return how many starts there are, and their errors."""
    table: F64 = np.array(
        [
            [
                s.seconds,
                s.tilt_deg,
                100.0 * abs(s.scale - 1.0),
                100.0 * abs(s.velocity_scale - 1.0),
                100.0 * s.velocity_error,
            ]
            for s in starts
        ]
    )
    known = table[np.isfinite(table[:, 0])]
    limit_s = 2.0 if starts[0].cameras > 1 else 4.0
    result = {
        "starts": float(len(table)),
        "failed": float(len(table) - len(known)),
        f"within {limit_s:g} s": float(np.mean(table[:, 0] <= limit_s)),
        "at most 1 deg": float(np.mean(known[:, 1] <= 1.0)),
        "scale at most 3 %": float(np.mean(known[np.isfinite(known[:, 2]), 2] <= 3.0)),
    }
    result["velocity's scale at most 3 %"] = float(
        np.mean(known[np.isfinite(known[:, 3]), 3] <= 3.0)
    )
    names = ("seconds", "tilt [deg]", "scale [%]", "velocity's scale [%]", "velocity [%]")
    for name, column in zip(names, known.T, strict=True):
        result[f"{name}, median"] = float(np.nanmedian(column))
        result[f"{name}, largest"] = float(np.nanmax(column))
    return result


def main() -> None:
    """Measure and print; write JSON if asked to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("flights", nargs="*", default=FLIGHTS, help="of " + ", ".join(FLIGHTS))
    parser.add_argument("--imu", choices=("simulated", "recorded"), default="simulated")
    parser.add_argument("--every", type=float, default=5.0, help="seconds between starts")
    parser.add_argument("--cameras", type=int, choices=(1, 2), nargs="+", default=(2, 1))
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    results: dict[int, list[Start]] = {count: [] for count in arguments.cameras}
    for cameras, starts in results.items():
        for name in arguments.flights:
            tracks = flight(name, cameras, arguments.imu)
            length_s = (tracks.frames[-1].time_ns - tracks.frames[0].time_ns) * 1e-9
            for begin_s in np.arange(0.5, length_s - 5.0, arguments.every).tolist():
                starts.append(start(tracks, name, begin_s))
                print(
                    {k: _rounded(v) for k, v in dataclasses.asdict(starts[-1]).items()}, flush=True
                )
        print(
            f"{cameras} cameras", {k: _rounded(v) for k, v in summary(starts).items()}, flush=True
        )
    if arguments.json:
        every = [dataclasses.asdict(s) for starts in results.values() for s in starts]
        arguments.json.write_text(json.dumps(every, indent=1) + "\n", encoding="utf-8")


def _rounded(value: float | str) -> float | str:
    return value if isinstance(value, str) else round(value, 3)


if __name__ == "__main__":
    main()
