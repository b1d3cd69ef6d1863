"""Localisation online: `python -m tests.benchmarks.online_localization simulated|euroc [options]`.

`simulated` rebuilds table 4.1 of the thesis: share of the map's landmarks, absolute error of VIL, SWL,
pose and ODO (median and standard deviation), and NEES of T_G_I. `euroc` localises pieces of V1_01 in
the others. Without map tracking the matcher is the thesis'.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.algorithms.localization.options import LocalizationOptions
from maplab_py.frontend.localization.options import OnlineLocalizationOptions
from maplab_py.interop.recordings.map_replay import MapRecording
from tests.benchmarks.online_localization import euroc
from tests.benchmarks.online_localization.modes import MODES, PoseErrors, compare, pose_errors
from tests.benchmarks.online_localization.simulated import SHARES, Setting, searched, setting
from tests.frontend.known_start import KnownStart
from tests.support.data import shared_data_folder

VARIANTS = {
    "none": OnlineLocalizationOptions(),
    "map": OnlineLocalizationOptions(landmark_uncertainty="map"),
    "index": OnlineLocalizationOptions(map_tracking=False),
}
"""Landmarks exact, landmarks estimated, and landmarks exact without map tracking."""

SPARSE = LocalizationOptions(min_inlier_count=6)
"""Of the simulated maps: 2.5 % are about a hundred landmarks. Two answers have to agree anyway."""


def measured(
    of: Setting, share: float, options: OnlineLocalizationOptions
) -> tuple[dict[str, PoseErrors], dict[str, Any]]:
    """Return errors by mode, and counts and processor times, at one share of the landmarks."""
    summary = of.summary(share)
    truth = of.truth_in_map(summary)
    map_ = searched(summary, share, with_covariances=options.rule.estimates_landmarks)
    start = KnownStart(of.start, with_biases=True)
    result = compare(MapRecording(of.query, 0), map_, options, make_starter=start)
    errors = {
        mode: pose_errors(result.results[mode], of.times_ns, truth, result.frames) for mode in MODES
    }
    spent = {name: float(np.median(ms)) for name, ms in result.cpu_ms.items() if len(ms)}
    return errors, {
        "landmarks": len(map_.database.p_G),
        "cpu_ms": spent,
        **dataclasses.asdict(result.counts),
    }


def simulated(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Run all seeds, shares and variants; print each and the medians."""
    rows: list[dict[str, Any]] = []
    for seed in arguments.seeds:
        of = setting(seed, duration_s=arguments.seconds, landmarks=arguments.landmarks)
        print(f"seed {seed}: {of.landmarks} good landmarks", flush=True)
        for share in arguments.shares:
            for variant in arguments.variants:
                options = dataclasses.replace(VARIANTS[variant], matching=SPARSE)
                errors, rest = measured(of, share, options)
                for mode, error in errors.items():
                    row = {"seed": seed, "share": share, "variant": variant, "mode": mode}
                    rows.append({**row, **dataclasses.asdict(error), **rest})
                    print(_line(rows[-1]), flush=True)
        print_medians(rows)
        if arguments.json:
            arguments.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return rows


def print_medians(rows: list[dict[str, Any]]) -> None:
    """Print medians over the seeds, and how often VIL is better than every baseline."""
    keys = dict.fromkeys((row["variant"], row["share"]) for row in rows)
    for variant, share in keys:
        chosen = [row for row in rows if (row["variant"], row["share"]) == (variant, share)]
        by_mode = {mode: [row for row in chosen if row["mode"] == mode] for mode in MODES}
        parts = []
        for mode, of_mode in by_mode.items():
            median, std = (
                100 * np.nanmedian([r[n] for r in of_mode]) for n in ("median_m", "std_m")
            )
            parts.append(f"{mode} {median:.2f}/{std:.2f} cm")
        vil = [row["median_m"] for row in by_mode["vil"]]
        others = np.array([[row["median_m"] for row in by_mode[mode]] for mode in MODES[1:]])
        best = int(np.count_nonzero(np.all(np.array(vil) < others, axis=0)))
        nees = np.nanmedian([row["nees_position"] for row in by_mode["vil"]])
        print(
            f"{len(vil)} seeds, {variant}, {100 * share:g} %: {', '.join(parts)}; VIL best in {best}; "
            f"NEES {nees:.1f}",
            flush=True,
        )


def real(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Localise pieces of V1_01 in the others; print errors by mode."""
    shared, rows = shared_data_folder(), []
    for variant in arguments.variants:
        errors, _ = euroc.measure(
            shared / "maplab_maps" / "euroc_v1_01",
            shared / "euroc_imu" / "V101.gt.csv",
            VARIANTS[variant],
        )
        for mode, error in errors.items():
            rows.append({"variant": variant, "mode": mode, **dataclasses.asdict(error)})
            print(rows[-1], flush=True)
    return rows


def _line(row: dict[str, Any]) -> str:
    return (
        f"seed {row['seed']}  {100 * row['share']:5.1f} %  {row['variant']:5}  {row['mode']:4}  "
        f"median {100 * row['median_m']:6.2f}  std {100 * row['std_m']:6.2f}  "
        f"largest {100 * row['largest_m']:6.2f} cm  localised {100 * row['localized_share']:5.1f} %  "
        f"NEES {row['nees_position']:6.1f}"
    )


def main() -> None:
    """Run a study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("study", choices=("simulated", "euroc"))
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(1, 11)))
    parser.add_argument("--shares", type=float, nargs="+", default=list(SHARES))
    parser.add_argument("--variants", nargs="+", choices=tuple(VARIANTS), default=["none", "map"])
    parser.add_argument("--seconds", type=float, default=30.0, help="of a flight")
    parser.add_argument("--landmarks", type=int, default=12_000, help="of the room")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = simulated(arguments) if arguments.study == "simulated" else real(arguments)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
