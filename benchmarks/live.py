"""Maps of running robots against maps of folders: `python -m benchmarks.live table|localized|hours`.

`table` plays ten seconds of EuRoC's MH_01 by each robot into `rovioli`, at real time, at half of it, and no
faster than the odometry follows (rate 0), and compares the map with that of the folder: lost sets,
difference, delay of the poses, processor time. `localized` localises in a summary map of the recording, on
the folder and live. `hours` plays a rendered flight forward and backward for so long, as fast as the odometry
follows, and looks at the memory.
"""

import argparse
import dataclasses
import re
import resource
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

import maplab_py.simulation
from maplab_py.array_types import F64
from maplab_py.storage.native import load_map
from tests.interop.live.robots import (
    PLAYERS,
    LiveRun,
    last_report,
    maplab,
    run_live,
    write_messages,
)
from tests.interop.recordings.written import write_calibration
from tests.support.data import shared_data

_LONGEST_S = 900.0
_COLUMNS = (
    "robot", "rate", "sets sent", "sets used", "left out", "IMU sent", "IMU lost",
    "ATE to the folder [mm]", "pose after stamp, median [ms]", "99 % [ms]",
    "processor [s]", "player late [ms]",
)  # fmt: skip


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("table", "localized", "hours"))
    parser.add_argument("--robots", nargs="*", default=list(PLAYERS), choices=list(PLAYERS))
    parser.add_argument("--rates", nargs="*", type=float, default=[1.0, 0.5, 0.0])
    parser.add_argument("--minutes", type=float, default=60.0, help="of hours")
    parser.add_argument("--flight", type=Path, help="rendered flight of hours, made if missing")
    parser.add_argument("--folder", type=Path, help="keep what the programs print")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = chosen.folder or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        if chosen.what == "table":
            _table(folder, chosen.robots, chosen.rates)
        elif chosen.what == "localized":
            _localized(folder, chosen.robots[:1], chosen.rates[-1:])
        else:
            _hours(folder, chosen.flight or folder / "flight", chosen.minutes)


def _table(folder: Path, robots: Sequence[str], rates: Sequence[float]) -> None:
    source = shared_data("euroc_mh01_10s")
    write_messages(source, folder)
    expected, spent_s = _on_folder(f"rovioli {source} --save_map_folder={folder / 'map'}")
    print("|", " | ".join(_COLUMNS), "|\n|", "---|" * len(_COLUMNS))
    _print_row("folder", "", "", expected["frames"], *[""] * 6, f"{spent_s:.0f}", "")
    for robot in robots:
        for rate in rates:
            place = folder / f"{robot}_{rate:g}"
            place.mkdir()
            flags = f"--save_map_folder={place / 'map'}"
            flags += "" if rate else " --live_max_delay_s=60"  # no set is left out: the same input
            run = run_live(place, robot, folder, flags, _pace(rate), longest_s=_LONGEST_S)
            _print_row(robot, f"{rate:g}", *_row(run, folder / "map", place / "map"))


def _pace(rate: float) -> str:
    """Return the options of a player for a multiple of real time; 0 = no faster than the odometry follows."""
    return f"--rate {rate}" if rate else "--rate 0.4 --ahead_s 0.15"


def _row(run: LiveRun, expected: Path, live: Path) -> list[str]:
    """Return the columns of a run from the sets on."""
    if run.status:
        return [run.printed.strip().splitlines()[-1]]
    sent, report = run.seen["sent"], run.report
    notes = report["notes"]
    return [
        str(sent["0"]),
        str(report["frames"]),
        str(_left_out(notes, "of images")),
        str(sent["-1"]),
        str(_left_out(notes, "/imu0")),
        f"{1e3 * _ate_m(expected, live):.3f}",
        *(f"{value:.0f}" for value in np.percentile(run.seen["latency_ms"] or [np.nan], [50, 99])),
        f"{run.processor_s:.0f}",
        f"{run.seen['behind_pace_ms']:.0f}",
    ]


def _print_row(*columns: object) -> None:
    print("|", " | ".join(map(str, columns)), "|", flush=True)


def _left_out(notes: Sequence[str], about: str) -> int:
    """Return the sum of the counts with which the notes about something begin."""
    texts = [note.removeprefix("/imu0: ") for note in notes if about in note]
    return sum(int(count.group()) for text in texts if (count := re.search(r"\d+", text)))


def _ate_m(expected: Path, live: Path) -> float:
    """Return the RMS of the distances (no alignment) of vertices of the same times."""
    (times, p), (live_times, live_p) = (_positions(folder) for folder in (expected, live))
    _, rows, live_rows = np.intersect1d(times, live_times, return_indices=True)
    return float(np.sqrt(np.mean(np.sum((p[rows] - live_p[live_rows]) ** 2, axis=1))))


def _positions(folder: Path) -> tuple[Any, F64]:
    vi_map, _ = load_map(folder)
    return vi_map.vertices.timestamp_ns, vi_map.T_G_I[:, 4:]


def _on_folder(command: str) -> tuple[dict[str, Any], float]:
    """Run a command; return its report and its processor time."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(maplab(command), check=True, capture_output=True, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return last_report(done.stdout), spent_s


def _localized(folder: Path, robots: Sequence[str], rates: Sequence[float]) -> None:
    """Localise in the summary map of the recording, on the folder and live."""
    source = shared_data("euroc_mh01_10s")
    write_messages(source, folder)
    _on_folder(
        f"rovioli {source} --save_map_folder={folder / 'map'}; "
        f"summary_map --summary_map_save_path={folder / 'summary'}"
    )
    flags = f"--vio_localization_map_folder={folder / 'summary'} --export_localized_poses_to_csv="
    _on_folder(f"rovioli {source} {flags}{folder / 'localized.csv'}")
    expected = np.loadtxt(folder / "localized.csv", delimiter=",")
    print("| source | rate | frames | localised | T_G_I from that of the folder, RMS [mm] |")
    print("|---|---|---|---|---|")
    _print_row("folder", "", len(expected), int(expected[:, _IS_LOCALIZED].sum()), "")
    for robot in robots:
        for rate in rates:
            place = folder / f"localized_{robot}_{rate:g}"
            place.mkdir()
            to_file = f"{flags}{place / 'localized.csv'}"
            run = run_live(place, robot, folder, to_file, _pace(rate), longest_s=_LONGEST_S)
            if run.status:
                _print_row(robot, rate, run.printed.strip().splitlines()[-1])
                continue
            live = np.loadtxt(place / "localized.csv", delimiter=",")
            _, rows, live_rows = np.intersect1d(expected[:, 0], live[:, 0], return_indices=True)
            both = (expected[rows, _IS_LOCALIZED] > 0) & (live[live_rows, _IS_LOCALIZED] > 0)
            apart_m = expected[rows[both], 1:4] - live[live_rows[both], 1:4]
            rms_mm = 1e3 * np.sqrt(np.mean(np.sum(apart_m**2, axis=1)))
            count = int(live[:, _IS_LOCALIZED].sum())
            _print_row(robot, f"{rate:g}", len(live), count, f"{rms_mm:.3f}")


_IS_LOCALIZED = -2  # column of the file of localised poses


def _hours(folder: Path, flight: Path, minutes: float) -> None:
    """Play a flight for so long, and print the memory of rovioli."""
    if not flight.exists():
        _render(folder, flight)
    device = write_messages(flight / "raw" / "session_1", folder, cameras=(0,))
    _halve(folder, device)
    flags = f"--submap_spool={folder / 'spool'} --live_silence_s=15"
    options = f"--rate 4 --ahead_s 0.5 --rounds 1000000 --last_s {60.0 * minutes}"
    longest_s = 60.0 * minutes + 600.0
    run = run_live(folder, "jazzy", folder, flags, options, cameras=1, longest_s=longest_s)
    begin_s = run.memory_mb[0][0]
    print("| minutes | memory [MB] |\n|---|---|")
    for minute in sorted({0.5, 1.0, 2.0, 5.0, *np.arange(10.0, minutes + 1.0, 10.0).tolist()}):
        seen = [mb for s, mb in run.memory_mb if 0.0 <= s - begin_s - 60.0 * minute < 10.0]
        if seen:
            _print_row(f"{minute:g}", f"{max(seen):.1f}")
    later = [mb for s, mb in run.memory_mb if s - begin_s > 300.0]
    print(f"growth after five minutes: {max(later) - later[0]:.1f} MB" if later else "")
    report = run.report
    print(f"{report['frames']} frames, {report['duration_s']:.0f} s of recording")
    print(*report["notes"], sep="\n")


def _render(folder: Path, flight: Path) -> None:
    """Render a flight that begins and ends at rest; without biases, so that it can be played backward."""
    scenario = yaml.safe_load(
        (Path(maplab_py.simulation.__path__[0]) / "scenarios" / "flight_easy.yaml").read_text()
    )
    names = ("gyro_bias_walk", "accel_bias_walk", "gyro_bias_sigma", "accel_bias_sigma")
    scenario["imu"] = dict.fromkeys(names, 0.0)
    (folder / "flight.yaml").write_text(yaml.safe_dump(scenario))
    _on_folder(f"simulate --scenario={folder / 'flight.yaml'} --raw_data --map_folder={flight}")


def _halve(folder: Path, device: Any) -> None:
    """Halve the images of the first camera, and give the IMU bias walks that the estimator can use."""
    with np.load(folder / "messages.npz") as arrays:
        content = dict(arrays)
    size = content["pixels0"].shape[:0:-1]
    half = size[0] // 2, size[1] // 2
    content["pixels0"] = np.array(
        [cv2.resize(image, half, interpolation=cv2.INTER_AREA) for image in content["pixels0"]]
    )
    np.savez(folder / "messages.npz", **content)
    camera = device.cameras[0]
    focal, centre = np.split(camera.intrinsics, 2)
    smaller = dataclasses.replace(
        camera,
        intrinsics=np.concatenate([0.5 * focal, 0.5 * (centre + 0.5) - 0.5]),
        width_px=half[0],
        height_px=half[1],
    )
    imu = dataclasses.replace(
        device.imu,
        acc_bias_random_walk_noise_density=3e-3,
        gyro_bias_random_walk_noise_density=2e-5,
    )
    rig = dataclasses.replace(device.rig, cameras=(smaller,), T_B_C=device.rig.T_B_C[:1])
    changed = device.with_sensor(imu)
    sensors = {**changed.sensors.sensors, rig.id: rig}
    changed = dataclasses.replace(
        changed, sensors=dataclasses.replace(changed.sensors, sensors=sensors)
    )
    write_calibration(changed, folder / "sensors.yaml")


if __name__ == "__main__":
    main()
