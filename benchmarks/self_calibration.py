"""Run time of the self-calibration: informative segments, all data, Maye et al., joint filter.

python -m benchmarks.self_calibration [--lengths 60 120 240] [--gain_up_to 60] [--json FILE]

One simulated device (scenario ar_room) walks for so many seconds; the same motion goes on in longer
sessions. Processor times of one run each, with compiled kernels. `information gain` (Maye et al.)
calibrates with every candidate; it is measured for sessions up to --gain_up_to, because it takes
minutes.
"""

import argparse
import dataclasses
import json
import time
from collections.abc import Callable
from pathlib import Path

from maplab_py.algorithms.self_calibration.calibration import calibrate
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.segments.information_gain import select_by_gain
from maplab_py.algorithms.self_calibration.segments.selection import collect
from maplab_py.simulation.scenario import MotionOptions, SessionOptions
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from maplab_py.vimap import VIMap
from studies.joint_ekf import filter_jointly

OPTIONS = SelfCalibrationOptions(keep_unobservable_at_prior=True)
_ROUND_S = 60.0


@dataclasses.dataclass(frozen=True)
class Times:
    """Processor times [s] for one session; a time is nan where it was not measured."""

    session_s: float
    segments: int
    kept: int
    selection_each_s: float
    calibration_s: float
    batch_s: float
    filter_s: float
    gain_s: float
    gain_kept: int
    gain_same_s: float  # until it has kept as many segments as we do

    @property
    def ours_s(self) -> float:
        """Selection of all segments, and calibration on those that are kept."""
        return self.segments * self.selection_each_s + self.calibration_s


def walk(length_s: float) -> VIMap:
    """Record a session: a scan, turns on the spot and figures of eight, a minute each round."""
    scenario = load_scenario("ar_room")
    phases = list[MotionOptions]()
    for number in range(max(round(length_s / _ROUND_S), 1)):
        start = 0.37 * number
        phases += [
            MotionOptions(kind="room_scan", duration_s=22.0, turns=0.5, start_turn=start),
            MotionOptions(kind="rotation", duration_s=8.0, turns=0.4, look_around_rad=0.35),
            MotionOptions(kind="figure_8", duration_s=22.0, turns=0.5, start_turn=start),
            MotionOptions(kind="stationary", duration_s=8.0),
        ]
    session = SessionOptions(phases=tuple(phases))
    return simulate(dataclasses.replace(scenario, sessions=(session,))).maps[0]


def processor_s(what: Callable[[], object]) -> float:
    """Return the processor time [s] of a call, all threads together."""
    began = time.process_time()
    what()
    return time.process_time() - began


def measure(length_s: float, *, with_gain: bool) -> Times:
    """Measure one session."""
    vi_map = walk(length_s)
    began = time.process_time()
    database, report = collect(vi_map, OPTIONS)
    selection_s = (time.process_time() - began) / report.segments_evaluated
    gain_s = gain_same_s = float("nan")
    gain_kept = 0
    if with_gain:
        began = time.process_time()
        gain_kept = len(select_by_gain(vi_map, OPTIONS))
        gain_s = time.process_time() - began
        count = len(database)
        gain_same_s = processor_s(lambda: select_by_gain(vi_map, OPTIONS, max_segments=count))
    return Times(
        session_s=length_s,
        segments=report.segments_evaluated,
        kept=len(database),
        selection_each_s=selection_s,
        calibration_s=processor_s(lambda: calibrate(database.vi_map, OPTIONS)),
        batch_s=processor_s(lambda: calibrate(vi_map, OPTIONS)),
        filter_s=processor_s(lambda: filter_jointly(vi_map, OPTIONS)),
        gain_s=gain_s,
        gain_kept=gain_kept,
        gain_same_s=gain_same_s,
    )


def main() -> None:
    """Print a table, and write JSON when asked to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lengths", type=float, nargs="+", default=[60.0, 120.0, 240.0])
    parser.add_argument("--gain_up_to", type=float, default=60.0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    measure(_ROUND_S, with_gain=False)  # compiles kernels
    print("| session s | segments | kept | selection s each | calibration s | batch s | ratio | "
          "ratio with selection | filter s | information gain s | of ours | "
          "until as many are kept s |")  # fmt: skip
    print("|---" * 12 + "|")
    found = []
    for length_s in arguments.lengths:
        one = measure(length_s, with_gain=length_s <= arguments.gain_up_to)
        found.append(one)
        print(
            f"| {one.session_s:.0f} | {one.segments} | {one.kept} | {one.selection_each_s:.3f} | "
            f"{one.calibration_s:.2f} | {one.batch_s:.2f} | "
            f"{one.calibration_s / one.batch_s:.2f} | {one.ours_s / one.batch_s:.2f} | "
            f"{one.filter_s:.1f} | {one.gain_s:.1f} ({one.gain_kept} kept) | "
            f"{one.gain_s / one.ours_s:.1f} | {one.gain_same_s:.1f} |",
            flush=True,
        )
    if arguments.json:
        text = json.dumps([dataclasses.asdict(one) for one in found], indent=2)
        arguments.json.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
