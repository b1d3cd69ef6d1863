"""Localisation online: `python -m benchmarks.online_localization simulated|euroc|tango|images|timings`.

`simulated` rebuilds table 4.1 of the thesis: share of the map's landmarks, absolute error of VIL, SWL,
pose and ODO (median and standard deviation), and NEES of T_G_I. `euroc` localises pieces of V1_01 in
the others, `tango` the second half of a walk in the first; `images` localises a flight in the map of
another one, images end to end; `timings` rebuilds table 4.2. Without map tracking the matcher is the
thesis'.
"""

import argparse
import dataclasses
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.online_localization import euroc, images, tango, timings
from benchmarks.online_localization.modes import MODES, compare_all, pose_errors
from benchmarks.online_localization.simulated import SHARES, Setting, searched, setting
from maplab_py.algorithms.localization.options import LocalizationOptions
from maplab_py.estimation.window.options import WindowOptions
from maplab_py.frontend.localization.options import OnlineLocalizationOptions
from maplab_py.frontend.odometry_options import OdometryOptions
from maplab_py.interop.recordings.map_replay import MapRecording
from tests.frontend.known_start import KnownStart
from tests.support.data import shared_data_folder

Row = dict[str, Any]

VARIANTS = {
    "none": OnlineLocalizationOptions(),
    "map": OnlineLocalizationOptions(landmark_uncertainty="map"),
    "index": OnlineLocalizationOptions(map_tracking=False),
}
"""Landmarks exact, landmarks estimated, and landmarks exact without map tracking."""

SPARSE = LocalizationOptions(min_inlier_count=6)
"""Of the simulated maps: 2.5 % are about a hundred landmarks. Two answers have to agree anyway."""


def of_seed(seed: int, of: Setting, shares: list[float], variants: list[str]) -> list[Row]:
    """Return errors, counts and processor times of all shares and variants of a seed; print each."""
    print(f"seed {seed}: {of.landmarks} good landmarks", flush=True)
    keys, cases, truths = [], [], []
    for share in shares:
        summary = of.summary(share)
        truth = of.truth_in_map(summary)
        for variant in variants:
            options = dataclasses.replace(VARIANTS[variant], matching=SPARSE)
            has_covariances = options.rule.estimates_landmarks
            cases.append((searched(summary, share, with_covariances=has_covariances), options))
            keys.append((share, variant))
            truths.append(truth)
    start = KnownStart(of.start, with_biases=True)
    results = compare_all(MapRecording(of.query, 0), cases, make_starter=start)
    rows: list[Row] = []
    for (share, variant), (map_, _), truth, result in zip(
        keys, cases, truths, results, strict=True
    ):
        spent = {name: float(np.median(ms)) for name, ms in result.cpu_ms.items() if len(ms)}
        counts = dataclasses.asdict(result.counts)
        for mode in MODES:
            error = pose_errors(result.results[mode], of.times_ns, truth, result.frames)
            row = {"seed": seed, "share": share, "variant": variant, "mode": mode}
            row |= {**dataclasses.asdict(error), **counts}
            rows.append({**row, "landmarks": len(map_.database.p_G), "cpu_ms": spent})
            print(_line(rows[-1]), flush=True)
    return rows


def simulated(arguments: argparse.Namespace) -> list[Row]:
    """Run all seeds, or read those that the folder has; print their medians."""
    rows: list[Row] = []
    for seed in arguments.seeds:
        file = None if arguments.folder is None else arguments.folder / f"seed_{seed}.json"
        if file is not None and file.exists():
            rows += json.loads(file.read_text(encoding="utf-8"))
            continue
        of = setting(seed, duration_s=arguments.seconds, landmarks=arguments.landmarks)
        rows += of_seed(seed, of, arguments.shares, arguments.variants)
        if file is not None:
            chosen = [row for row in rows if row["seed"] == seed]
            file.write_text(json.dumps(chosen, indent=1) + "\n", encoding="utf-8")
    print_medians(rows)
    print_ratios(rows)
    return rows


def print_medians(rows: list[Row]) -> None:
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


def print_ratios(rows: list[Row]) -> None:
    """Print medians over the seeds of the ratios that the thesis' table shows."""
    by_key = {(r["variant"], r["seed"], r["share"], r["mode"]): r for r in rows}
    seeds = sorted({row["seed"] for row in rows})
    for variant in dict.fromkeys(row["variant"] for row in rows):
        for share in dict.fromkeys(row["share"] for row in rows):
            pairs = [
                (by_key[variant, seed, share, "vil"], by_key[variant, seed, share, "swl"])
                for seed in seeds
                if (variant, seed, share, "vil") in by_key
            ]
            if not pairs:
                continue
            parts = [
                f"{name} {np.nanmedian([vil[field] / swl[field] for vil, swl in pairs]):.2f}"
                for name, field in (("median", "median_m"), ("std", "std_m"))
            ]
            print(f"{variant}, {100 * share:g} %, VIL / SWL: {', '.join(parts)}", flush=True)
        sparse = [
            by_key[variant, seed, 0.05, "vil"]["median_m"]
            / by_key[variant, seed, 0.5, "vil"]["median_m"]
            for seed in seeds
            if (variant, seed, 0.05, "vil") in by_key and (variant, seed, 0.5, "vil") in by_key
        ]
        if sparse:
            print(f"{variant}, VIL 5 % / VIL 50 %: median {np.median(sparse):.2f}", flush=True)


def real(arguments: argparse.Namespace) -> list[Row]:
    """Localise pieces of V1_01 in the others; print errors by mode."""
    shared, rows = shared_data_folder(), []
    for variant in arguments.variants:
        errors, _ = euroc.measure(
            shared / "maplab_maps" / "euroc_v1_01",
            shared / "euroc_imu" / "V101.gt.csv",
            VARIANTS[variant],
            odometry_options=OdometryOptions(
                window=WindowOptions(num_keyframes=arguments.keyframes)
            ),
        )
        for mode, error in errors.items():
            rows.append({"variant": variant, "mode": mode, **dataclasses.asdict(error)})
            print(rows[-1], flush=True)
    return rows


def exploration(arguments: argparse.Namespace) -> list[Row]:
    """Localise the second half of the Tango walk in the first; print errors and absences."""
    rows: list[Row] = []
    for variant in arguments.variants:
        folder = shared_data_folder() / "maplab_maps" / "tango_handheld"
        result = tango.measure(folder, VARIANTS[variant])
        rows.append({"variant": variant, **dataclasses.asdict(result)})
        for name, value in rows[-1].items():
            parts = value if isinstance(value, list) else [value]
            parts = list(value.items()) if isinstance(value, dict) else parts
            for part in parts:
                print(f"{name}: {part}", flush=True)
    return rows


def end_to_end(arguments: argparse.Namespace) -> list[Row]:
    """Localise a flight by its images, with one camera and with both; print errors and times."""
    rows: list[Row] = []
    for cameras in ("0", ""):
        with tempfile.TemporaryDirectory() as work:
            errors = images.measure(arguments.images, cameras, Path(work))
        ratios = {"localized_ratio": errors.localized_ratio, "batch_ratio": errors.batch_ratio}
        rows.append({**dataclasses.asdict(errors), **ratios})
        print({name: round(value, 4) for name, value in rows[-1].items()}, flush=True)
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
    parser.add_argument("study", choices=("simulated", "euroc", "tango", "images", "timings"))
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(1, 11)))
    parser.add_argument("--shares", type=float, nargs="+", default=list(SHARES))
    parser.add_argument("--variants", nargs="+", choices=tuple(VARIANTS), default=["none", "map"])
    parser.add_argument("--seconds", type=float, default=30.0, help="of a flight")
    parser.add_argument("--landmarks", type=int, default=12_000, help="of the room")
    parser.add_argument(
        "--keyframes", type=int, default=0, help="of the window (euroc); 0 = default"
    )
    parser.add_argument("--folder", type=Path, help="with a file per seed; seeds in it are not run")
    parser.add_argument("--images", type=Path, help="folder with the rendered flights; else MH_01")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    if arguments.study == "timings":
        timings.main()
        return
    studies = {
        "simulated": simulated, "euroc": real, "tango": exploration, "images": end_to_end,
    }  # fmt: skip
    rows = studies[arguments.study](arguments)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
