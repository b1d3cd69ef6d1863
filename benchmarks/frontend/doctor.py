"""The doctor of recordings: `python -m benchmarks.frontend.doctor [--folder=FOLDER] [--json=FILE]`.

25 sound recordings, real ones and rendered ones, and as many with one planted fault each. Counted are
faults that are named first, and sound recordings in which something is called wrong.
"""

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from maplab_py.algorithms.recording_check.correction import correct
from maplab_py.algorithms.recording_check.doctor import diagnose, first_cause
from maplab_py.frontend.data_source import open_source
from maplab_py.frontend.run_options import DataSourceOptions
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.interop.recordings.protocol import Recording
from maplab_py.interop.recordings.reader_choice import open_recording
from maplab_py.simulation.raw_data import write_raw_data
from maplab_py.simulation.scenario import CameraOptions, MotionOptions, Scenario, SessionOptions
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from tests.algorithms.recording_check import faults
from tests.support.data import shared_data_folder

_REST = MotionOptions(kind="stationary", duration_s=2.0)
_FISHEYE = CameraOptions(
    distortion="equidistant",
    intrinsics=(190.98, 190.97, 254.93, 256.90),
    distortion_parameters=(0.0034, 0.0007, -0.0020, 0.0002),
    width_px=512,
    height_px=512,
)


def rendered() -> dict[str, Scenario]:
    """Return the scenarios that are rendered, by name."""

    def flight(name: str, seed: int, *phases: MotionOptions) -> Scenario:
        scenario = load_scenario(name).with_seed(seed)
        session = dataclasses.replace(scenario.sessions[0], phases=(_REST, *phases))
        return dataclasses.replace(scenario, sessions=(session,))

    def scan(duration_s: float, turns: float, kind: str = "room_scan") -> MotionOptions:
        return MotionOptions(
            kind=kind, duration_s=duration_s, turns=turns, wall_distance_m=2.6, shake_m=0.02,
            shake_rad=0.04,
        )  # fmt: skip

    euroc = shared_data_folder() / "euroc_imu"
    tumvi = shared_data_folder() / "tumvi_imu"
    vicon = dataclasses.replace(
        load_scenario("flight_easy").with_seed(6),
        sessions=(
            SessionOptions(
                trajectory=str(euroc / "V101.gt.csv"), trajectory_start_s=2.0, duration_s=20.0
            ),
        ),
    )
    handheld = dataclasses.replace(
        load_scenario("flight_easy").with_seed(7),
        cameras=(_FISHEYE,),
        sessions=(SessionOptions(trajectory=str(tumvi / "room4.gt.csv"), duration_s=20.0),),
    )
    rolling = dataclasses.replace(
        flight("flight_easy", 8, scan(16.0, 0.7)),
        cameras=(CameraOptions(line_delay_s=40e-6),),
    )
    scenarios = {
        "bright": flight("flight_easy", 1, scan(16.0, 0.6)),
        "eight": flight("flight_easy", 2, scan(16.0, 0.5, "figure_8")),
        "fast": flight("flight_fast", 3, scan(10.0, 0.8)),
        "dark": flight("flight_dark", 4, scan(16.0, 0.6)),
        "turning": flight(
            "turn_on_the_spot",
            5,
            MotionOptions(kind="rotation", duration_s=8.0, turns=0.7, look_around_rad=0.2),
            scan(8.0, 0.3),
        ),
        "vicon": vicon,
        "handheld": handheld,
        "rolling": rolling,
    }
    return {name: _with_few_points(scenario) for name, scenario in scenarios.items()}


def _with_few_points(scenario: Scenario) -> Scenario:
    """Return a scenario of images ten times a second; its simulated keypoints are not needed."""
    world = dataclasses.replace(scenario.world, landmarks_per_room=200)
    measurement = dataclasses.replace(scenario.measurement, frame_rate_hz=10.0, max_keypoints=50)
    return dataclasses.replace(scenario, world=world, measurement=measurement)


def render_all(folder: Path) -> dict[str, Path]:
    """Render what the folder does not have yet; return the recordings."""
    recordings = {}
    for name, scenario in rendered().items():
        target = folder / name
        recordings[name] = target / "raw" / "session_1"
        done = target / "done"
        if not done.exists():
            write_raw_data(scenario, simulate(scenario), target, overwrite=True)
            done.touch()
    return recordings


@dataclasses.dataclass(frozen=True)
class Case:
    """One recording, and the beginning of the check that must be named first; empty = sound."""

    name: str
    open: Callable[[], Recording]
    names: tuple[str, ...] = ()
    says: str = ""  # in the line of that check


def _opener(folder: Path, cameras: str = "") -> Callable[[], Recording]:
    options = SourceOptions(rovio_active_camera_indices=cameras)
    return lambda: open_recording(folder, options)


def _walk(shared: Path) -> Recording:
    """Return the walk with the calibration that the doctor has mended: nothing is wrong any more."""
    folder = shared / "handheld_room_70s"
    opened = open_recording(
        folder,
        SourceOptions(
            sensor_calibration_file=folder / "camchain-imucam.yaml",
            imu_calibration_file=folder / "imu.yaml",
        ),
    )
    device, _ = correct(diagnose(opened))
    offset_ns = device.cameras[0].time_offset_ns
    return dataclasses.replace(faults.sound(opened), device=device, imu_shift_ns=-offset_ns)


def sound_cases(folders: dict[str, Path], shared: Path) -> list[Case]:
    """Return 25 recordings in which nothing is wrong."""
    euroc = shared / "euroc_mh01_10s"
    cases = [Case(f"MH_01 {rows or 'all'}", _opener(euroc, rows)) for rows in ("", "0", "1")]
    stereo = [name for name in folders if name not in ("handheld", "rolling")]
    cases += [
        Case(f"{name} {rows or 'all'}", _opener(folders[name], rows))
        for name in stereo
        for rows in ("", "0", "1")
    ]
    cases += [Case(name, _opener(folders[name])) for name in ("handheld", "rolling")]
    tango = shared / "maplab_maps" / "tango_handheld"
    cases.append(Case("tango", lambda: open_source(tango, DataSourceOptions(), SourceOptions())))
    cases.append(Case("walk, mended", lambda: _walk(shared)))
    return cases


def faulty_cases(folders: dict[str, Path], shared: Path) -> list[Case]:
    """Return 25 recordings with one fault each."""
    eye, axes = np.eye(3), faults.AXES
    folders = {**folders, "MH_01": shared / "euroc_mh01_10s"}
    cases: list[Case] = []

    def add(base: str, rows: str, fault: str, names: tuple[str, ...],
            plant: Callable[[Recording], Recording], says: str = "") -> None:  # fmt: skip
        opener, name = _opener(folders[base], rows), f"{base} {rows or 'all'}: {fault}"
        cases.append(Case(name, lambda: plant(opener()), names, says))

    unit_g, unit_a = ("unit of the gyroscope",), ("unit of the accelerometer",)
    axes_g, axes_a = ("axes of the gyroscope",), ("axes of the accelerometer",)
    offset, mounting = ("time offset",), ("rotation of the extrinsics",)
    noise_a, noise_g = ("noise of the accelerometer",), ("noise of the gyroscope",)
    to_deg = 180.0 / np.pi
    add("MH_01", "", "gyroscope in deg/s", unit_g, lambda r: faults.with_imu(r, eye, to_deg * eye))
    add("dark", "0", "gyroscope in deg/s", unit_g, lambda r: faults.with_imu(r, eye, to_deg * eye))
    add("MH_01", "0", "accelerometer in g", unit_a, lambda r: faults.with_imu(r, eye / 9.81, eye))
    add("eight", "", "accelerometer in mg", unit_a,
        lambda r: faults.with_imu(r, 1000.0 / 9.81 * eye, eye))  # fmt: skip
    add("vicon", "0", "gyroscope x, y swapped", axes_g,
        lambda r: faults.with_imu(r, eye, axes["swap xy"]))  # fmt: skip
    add("MH_01", "", "gyroscope z flipped", axes_g,
        lambda r: faults.with_imu(r, eye, axes["flip z"]))  # fmt: skip
    add("bright", "", "IMU x, y swapped", axes_g,
        lambda r: faults.with_imu(r, axes["swap xy"], axes["swap xy"]))  # fmt: skip
    add("handheld", "", "accelerometer turned", axes_a,
        lambda r: faults.with_imu(r, axes["turn x"], eye))  # fmt: skip
    add("vicon", "", "accelerometer x, y swapped", axes_a,
        lambda r: faults.with_imu(r, axes["swap xy"], eye))  # fmt: skip
    add("MH_01", "", "accelerometer negative", ("sign of the accelerometer",),
        lambda r: faults.with_imu(r, -eye, eye))  # fmt: skip
    add("MH_01", "", "clock 30 ms", offset, lambda r: faults.with_clock(r, 0.03))
    add("turning", "0", "clock -15 ms", offset, lambda r: faults.with_clock(r, -0.015))
    add("bright", "1", "clock 1 s", offset, lambda r: faults.with_clock(r, 1.0))
    add("eight", "0", "clock 1 h", ("IMU and images",), lambda r: faults.with_clock(r, 3600.0))
    add("MH_01", "0", "camera turned 5 deg", mounting,
        lambda r: faults.with_rig(r, turn_deg=(0.0, 5.0, 0.0)))  # fmt: skip
    add("vicon", "", "cameras turned 20 deg", mounting,
        lambda r: faults.with_rig(r, turn_deg=(0.0, 0.0, 20.0)))  # fmt: skip
    add("handheld", "", "camera turned 90 deg", mounting,
        lambda r: faults.with_rig(r, turn_deg=(0.0, 0.0, 90.0)))  # fmt: skip
    add("MH_01", "", "gyroscope 1.1", ("scale of the gyroscope",),
        lambda r: faults.with_imu(r, eye, 1.1 * eye))  # fmt: skip
    add("eight", "", "noise of the gyroscope 0.1", noise_g,
        lambda r: faults.with_noise_figures(r, 1.0, 0.1))  # fmt: skip
    add("bright", "0", "noise of the accelerometer 20", noise_a,
        lambda r: faults.with_noise_figures(r, 20.0, 1.0))  # fmt: skip
    add("MH_01", "", "under-exposed", ("light of camera",),
        lambda r: faults.with_pixels(r, lambda p: (p * 0.06).astype(np.uint8)))  # fmt: skip
    add("turning", "", "over-exposed", ("light of camera",),
        lambda r: faults.with_pixels(
            r, lambda p: np.minimum(p.astype(np.uint16) * 5, 255).astype(np.uint8)))  # fmt: skip
    add("MH_01", "", "frozen", ("change of camera",), lambda r: faults.with_repeats(r, 0))
    add("MH_01", "", "cameras swapped", ("cameras 0 and 1",), faults.with_swapped_images,
        "cameras exchanged")  # fmt: skip
    add("bright", "", "focal length of camera 1", ("cameras 0 and 1",),
        lambda r: faults.with_rig(r, rows=(1,), camera=faults.focal(1.06)),
        "intrinsics or distortion of camera 1")  # fmt: skip
    return cases


def main() -> None:
    """Check all recordings and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path("doctor_recordings"))
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    shared = shared_data_folder()
    folders = render_all(arguments.folder)
    rows, named, alarms, sounds, faults_seen = [], 0, 0, 0, 0
    for case in (*sound_cases(folders, shared), *faulty_cases(folders, shared)):
        if arguments.only not in case.name:
            continue
        begin_s = time.process_time()
        recording = case.open()
        diagnosis = diagnose(recording)
        first = first_cause(diagnosis)
        spent_s = time.process_time() - begin_s
        named_check = first.check if first is not None else ""
        is_right = named_check.startswith(case.names) if case.names else first is None
        is_right = is_right and (first is None or case.says in first.line)
        if case.names:
            faults_seen, named = faults_seen + 1, named + is_right
        else:
            sounds, alarms = sounds + 1, alarms + (not is_right)
        line = first.line if first is not None else "nothing wrong"
        share = spent_s / max(diagnosis.signals.duration_s, 1e-9)
        mark = "right" if is_right else "WRONG"
        sys.stdout.write(f"{mark}  {share:5.2f} of real time  {case.name}: {line}\n")
        sys.stdout.flush()
        rows.append({"case": case.name, "is_right": bool(is_right), "cause": line, "share": share})
    sys.stdout.write(f"named first: {named} of {faults_seen}; false alarms: {alarms} of {sounds}\n")
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
