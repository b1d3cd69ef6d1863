"""Odometry on devices of strangers: `python -m benchmarks.frontend strangers [--seeds=20]`.

A seed draws a rendered recording (walk, handheld or flight) and what is wrong with it: line delay, clock,
extrinsics, figures of noise, units, axes, 12-bit images, exposure, blur, bare walls, rates that change,
merged stamps. Each is run as `rovioli` runs it, with the faults and once more with the true calibration.
A map whose error is more than twice that of the true calibration, and more than a hundredth of the path, is
wrong: the run has to say why, in a note that it does not give with the true calibration. So has a run that
does not start.
"""

import argparse
import dataclasses
import functools
import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.frontend.sequences import TRUTH, position_errors
from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.array_types import I64
from maplab_py.errors import EstimationError, UserError
from maplab_py.frontend.checked_run import run_checked
from maplab_py.frontend.finishing import finish
from maplab_py.frontend.mapping import Mapping
from maplab_py.frontend.odometry_update import OdometryUpdate
from maplab_py.geometry import se3, so3
from maplab_py.interop.images import Pixels
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.interop.recordings.protocol import CameraImage, RecordedSensors, Recording
from maplab_py.interop.recordings.reader_choice import open_recording
from maplab_py.interop.trajectories import Trajectory, read_trajectory
from maplab_py.sensors import CameraRig
from maplab_py.simulation.raw_data import write_raw_data
from maplab_py.simulation.scenario import CameraOptions, MotionOptions, Scenario, SessionOptions
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from maplab_py.vimap import VIMap
from tests.algorithms.recording_check import faults
from tests.support.data import shared_data_folder

Fault = Callable[[Recording], Recording]
_STREAM = 34
_START_S, _RATIO, _WRONG_SHARE = 4.0, 2.0, 0.01
"""Bars of start and error, and the error, as a share of the path, from which a map is called wrong."""
FISHEYE = CameraOptions(
    distortion="equidistant",
    intrinsics=(190.98, 190.97, 254.93, 256.90),
    distortion_parameters=(0.0034, 0.0007, -0.0020, 0.0002),
    width_px=512,
    height_px=512,
)


@dataclasses.dataclass(frozen=True)
class Stranger:
    """A recording, and what is wrong with it."""

    scenario: Scenario
    line_delay_s: float
    shift_s: float  # by which the IMU's stamps are later
    plants: tuple[tuple[str, Fault], ...]

    @property
    def words(self) -> str:
        """Return the faults in one line."""
        told = f"line delay {1e6 * self.line_delay_s:.0f} us; " if self.line_delay_s else ""
        return told + ", ".join(words for words, _ in self.plants)

    def faulty(self, recording: Recording) -> Recording:
        """Return a recording with the faults."""
        for _, plant in self.plants:
            recording = plant(recording)
        return recording

    def sound(self, recording: Recording) -> Recording:
        """Return a recording with its true line delay."""
        cameras = tuple(
            dataclasses.replace(
                camera,
                line_delay_ns=round(1e9 * self.line_delay_s),
                image_delay_s=-0.5 * self.line_delay_s * camera.height_px,
            )
            for camera in recording.device.cameras
        )
        device = recording.device.with_cameras(cameras, recording.device.T_I_C)
        return dataclasses.replace(faults.sound(recording), device=device)


def drawn(seed: int, duration_s: float) -> Stranger:
    """Return the stranger of a seed."""
    rng = np.random.default_rng([_STREAM, seed])
    scenario = load_scenario("strangers_device").with_seed(seed)
    cameras, rate_hz, session = _device_and_motion(seed, duration_s, rng)
    line_delay_s = float(rng.uniform(1e-5, 4e-5)) if rng.uniform() < 0.4 else 0.0
    cameras = tuple(dataclasses.replace(camera, line_delay_s=line_delay_s) for camera in cameras)
    is_bare, is_dark = rng.uniform(size=2) < 0.35
    images = dataclasses.replace(
        scenario.images,
        bare_share=0.35 if is_bare else 0.0,
        exposure_s=0.015 if is_dark else 0.004,
        noise_sigma=4.0 if is_dark else 2.0,
    )
    light = dataclasses.replace(
        scenario.sessions[0].images,
        light=0.4 if is_dark else 0.9,
        gain_jump=0.35 if rng.uniform() < 0.5 else 0.0,
    )
    scenario = dataclasses.replace(
        scenario,
        cameras=cameras,
        images=images,
        imu=dataclasses.replace(scenario.imu, time_offset_s=0.0),
        calibration=type(scenario.calibration)(),
        measurement=dataclasses.replace(scenario.measurement, frame_rate_hz=rate_hz),
        sessions=(dataclasses.replace(session, images=light),),
    )
    shift_s, plants = _plants(rng)
    return Stranger(scenario, line_delay_s, shift_s, tuple(plants))


def _device_and_motion(
    seed: int, duration_s: float, rng: np.random.Generator
) -> tuple[tuple[CameraOptions, ...], float, SessionOptions]:
    """Return cameras, image rate and motion."""
    shared, walk = shared_data_folder(), load_scenario("strangers_device")
    kind = ("walk", "handheld", "flight", "stereo walk")[seed % 4]
    rate_hz = float(rng.choice([10.0, 15.0, 20.0]))
    begin_s = float(rng.uniform(2.0, 30.0))
    stereo = load_scenario("flight_easy").cameras
    if kind == "handheld":
        file = shared / "tumvi_imu" / f"room{rng.choice([1, 4])}.gt.csv"
        return (FISHEYE,), rate_hz, _along(file, begin_s, duration_s)
    if kind == "flight":
        file = shared / "euroc_imu" / "V101.gt.csv"
        return stereo, rate_hz, _along(file, begin_s, duration_s)
    rest_s = float(rng.choice([0.0, 2.0]))
    scan = MotionOptions(
        kind=str(rng.choice(["room_scan", "figure_8"])), duration_s=duration_s - rest_s,
        turns=0.018 * duration_s, start_turn=float(rng.uniform()), wall_distance_m=2.4,
        shake_m=0.02, shake_rad=0.05,
    )  # fmt: skip
    rest = (MotionOptions(kind="stationary", duration_s=rest_s),) if rest_s else ()
    session = SessionOptions(phases=(*rest, scan))
    return stereo if kind == "stereo walk" else walk.cameras, rate_hz, session


def _along(file: Path, begin_s: float, duration_s: float) -> SessionOptions:
    return SessionOptions(trajectory=str(file), trajectory_start_s=begin_s, duration_s=duration_s)


def _plants(rng: np.random.Generator) -> tuple[float, list[tuple[str, Fault]]]:
    """Draw faults, and the clock's: one of four recordings has wrong samples, all a wrong calibration."""
    eye, plants = np.eye(3), []
    draw = rng.uniform(size=8)
    angle_deg = rng.uniform(0.0, 20.0) if draw[0] < 0.5 else rng.uniform(0.0, 1.0)
    axis, way = (vector / np.linalg.norm(vector) for vector in rng.standard_normal((2, 3)))
    moved_m = rng.uniform(0.0, 0.05)
    turn_deg, move_m = tuple(angle_deg * axis), tuple(moved_m * way)
    plants.append(
        (
            f"extrinsics {angle_deg:.1f} deg {1e2 * moved_m:.1f} cm",
            lambda r: faults.with_rig(r, turn_deg=turn_deg, move_m=move_m),
        )
    )
    shift_s = rng.uniform(-0.05, 0.05) if draw[1] < 0.5 else rng.uniform(-0.004, 0.004)
    plants.append((f"clock {1e3 * shift_s:+.1f} ms", lambda r: faults.with_clock(r, shift_s)))
    accel, gyro = np.exp(rng.uniform(np.log(0.1), np.log(20.0), 2))
    plants.append(
        (f"noise {accel:.2g} {gyro:.2g}", lambda r: faults.with_noise_figures(r, accel, gyro))
    )
    samples = {
        "gyroscope in deg/s": lambda r: faults.with_imu(r, eye, np.degrees(eye)),
        "accelerations in g": lambda r: faults.with_imu(r, eye / 9.81, eye),
        "gyroscope x, y swapped": lambda r: faults.with_imu(r, eye, faults.AXES["swap xy"]),
        "IMU z flipped": lambda r: faults.with_imu(r, faults.AXES["flip z"], faults.AXES["flip z"]),
    }
    if draw[2] < 0.25:
        words = str(rng.choice(list(samples)))
        plants.append((words, samples[words]))
    if draw[3] < 0.3:
        plants.append(("12 bits", _twelve_bits))
    if draw[4] < 0.3:
        plants.append(("half the images for 5 s", _halved_rate))
    if draw[5] < 0.3:
        plants.append(("stamps 0.2 ms apart", _merged_stamps))
    return shift_s, plants


def _twelve_bits(recording: Recording) -> Recording:
    """Store the images in words of 16 bits."""

    def wide(pixels: Pixels) -> Pixels:
        return (pixels.astype(np.uint16) << 4).astype(np.uint16)

    def changed(camera: int, count: int, image: CameraImage) -> CameraImage:
        return dataclasses.replace(image, data=faults.EditedImage(image, wide), bits=12)

    return dataclasses.replace(faults.sound(recording), edit_image=changed)


def _halved_rate(recording: Recording) -> Recording:
    """Leave out every second image from 8 to 13 s."""
    start_ns = recording.start_ns

    def changed(camera: int, count: int, image: CameraImage) -> CameraImage | None:
        is_within = 8e9 < image.time_ns - start_ns < 13e9
        return None if is_within and count % 2 else image

    return dataclasses.replace(faults.sound(recording), edit_image=changed)


def _merged_stamps(recording: Recording) -> Recording:
    """Give each sample twice, 0.2 ms apart, as drivers do that merge gyroscope and accelerometer."""
    return dataclasses.replace(faults.sound(recording), repeat_ns=200_000)


@dataclasses.dataclass(frozen=True)
class CalibrationErrors:
    """Largest errors of the calibration of a map over its cameras."""

    rotation_deg: float
    position_mm: float
    offset_ms: float  # of the middle row
    line_delay_ms: float  # from the first row to the last
    focal_percent: float
    centre_px: float

    @property
    def words(self) -> str:
        """Return the errors in one line."""
        return (
            f"{self.rotation_deg:.2f} deg, {self.position_mm:.1f} mm, offset {self.offset_ms:.2f} ms, rows "
            f"{self.line_delay_ms:.2f} ms, focal {self.focal_percent:.2f} %, centre {self.centre_px:.2f} px"
        )


@dataclasses.dataclass(frozen=True)
class Run:
    """Outcome of one run."""

    start_s: float = np.inf  # infinite = it has not started
    covered: float = 0.0  # share of the recording with vertices
    ate_m: float = np.nan  # of the map, each mission aligned
    optimised_m: float = np.nan  # after optvi --ba_calibration=auto
    path_m: float = 0.0
    missions: int = 0
    error_px: float = np.nan  # median over the frames of the window's median reprojection error
    calibration: CalibrationErrors | None = None  # of the map
    says: tuple[str, ...] = ()


def calibration_errors(vi_map: VIMap, sound: RecordedSensors, taken_ns: I64) -> CalibrationErrors:
    """Return the errors of the calibration of a map.

    Args:
        vi_map: The map.
        sound: The true calibration; images are stamped at their middle rows.
        taken_ns: When the images were taken by the clock of the IMU.
    """
    assert sound.imu is not None
    T_I_C = vi_map.sensors.T_I_C(sound.imu.id, sound.rig.id)
    rig = vi_map.sensors.sensors[sound.rig.id]
    assert isinstance(rig, CameraRig)
    pairs = list(zip(rig.cameras, sound.cameras, strict=True))
    off = se3.compose(se3.inverse(sound.T_I_C), T_I_C)
    heights = np.array([camera.height_px for camera, _ in pairs])
    line_s = np.array([1e-9 * camera.line_delay_ns for camera, _ in pairs])
    true_line_s = np.array([1e-9 * camera.line_delay_ns for _, camera in pairs])
    times_ns = np.sort(taken_ns)
    after = np.searchsorted(times_ns, vi_map.vertices.timestamp_ns).clip(1, len(times_ns) - 1)
    early_ns = vi_map.vertices.timestamp_ns - times_ns[[after - 1, after]]
    of_vertices_s = 1e-9 * np.median(np.where(-early_ns[1] < early_ns[0], early_ns[1], early_ns[0]))
    delays_s = np.array([camera.image_delay_s for camera, _ in pairs]) + 0.5 * heights * line_s
    focal = [c.intrinsics[:2] / true.intrinsics[:2] - 1.0 for c, true in pairs]
    centre = [c.intrinsics[2:4] - true.intrinsics[2:4] for c, true in pairs]
    return CalibrationErrors(
        float(np.degrees(np.linalg.norm(so3.log(off[:, :4]), axis=1).max())),
        1e3 * float(np.linalg.norm(off[:, 4:], axis=1).max()),
        1e3 * float(np.abs(delays_s + of_vertices_s).max()),
        1e3 * float(np.abs(heights * (line_s - true_line_s)).max()),
        1e2 * float(np.abs(focal).max()),
        float(np.abs(centre).max()),
    )


def run(
    recording: Recording,
    truth: Trajectory,
    sound: RecordedSensors,
    stamps_ns: I64,
    *,
    is_optimised: bool,
    shift_s: float = 0.0,
) -> Run:
    """Run as `rovioli` does; then as `optvi --ba_calibration=auto` if wanted.

    Vertices have times of the IMU's clock, later than the truth's by a shift, where that is found.
    """
    late = dataclasses.replace(truth, times_ns=truth.times_ns + round(1e9 * shift_s))
    truths = (truth, late)
    errors_px = [np.nan]

    def see(update: OdometryUpdate, mapping: Mapping) -> None:
        if update.window is not None:
            errors_px.append(update.window.median_error_px)

    try:
        mapping = run_checked(lambda read: Mapping(read, on_estimate=see), recording)
    except (UserError, EstimationError) as error:
        return Run(says=(str(error),))
    finished = finish(mapping, recording.name)
    vi_map = finished.vi_map
    assert vi_map is not None
    optimised = np.nan
    notes = list(finished.report.notes)
    if is_optimised:
        better, _ = optimize(vi_map, VIOptimizationOptions(calibration="auto"))
        optimised = min(error_m(better, of) for of in truths)
    times_ns = vi_map.vertices.timestamp_ns
    return Run(
        start_s=mapping.statistics.starts[0].time_s,
        covered=1e-9 * float(np.ptp(times_ns)) / mapping.statistics.duration_s,
        ate_m=min(error_m(vi_map, of) for of in truths),
        optimised_m=optimised,
        path_m=mapping.statistics.distance_m,
        missions=len(vi_map.missions),
        error_px=float(np.nanmedian(errors_px)),
        calibration=calibration_errors(vi_map, sound, stamps_ns + round(1e9 * shift_s)),
        says=tuple(notes),
    )


def error_m(vi_map: VIMap, truth: Trajectory) -> float:
    """Return the RMS error of all vertices, each mission aligned by itself."""
    squares, count = 0.0, 0
    for mission in range(len(vi_map.missions)):
        is_of = vi_map.vertices.mission == mission
        if np.count_nonzero(is_of) < 3:
            continue
        errors, _ = position_errors(truth, vi_map.vertices.timestamp_ns[is_of], vi_map.T_G_I[is_of])
        squares, count = squares + float(np.sum(errors**2)), count + len(errors)
    return float(np.sqrt(squares / max(count, 1)))


def rendered(folder: Path, seed: int, duration_s: float) -> tuple[Stranger, Path]:
    """Render the recording of a seed unless it is there; return both."""
    stranger = drawn(seed, duration_s)
    return stranger, rendered_once(stranger.scenario, folder / f"{seed}_{duration_s:g}s")


def rendered_once(scenario: Scenario, target: Path) -> Path:
    """Render the recording of a scenario's first session unless it is there; return its folder."""
    if not (target / "done").exists():
        write_raw_data(scenario, simulate(scenario), target, overwrite=True)
        (target / "done").touch()
    return target / "raw" / "session_1"


def verdict(faulty: Run, reference: Run) -> str:
    """Return how a run with faults ended."""
    says_more = [line for line in faulty.says if line not in reference.says]
    if not np.isfinite(faulty.start_s):
        return (
            "refused, named" if "check_recording" in " ".join(faulty.says) else "REFUSED, NO CAUSE"
        )
    if faulty.ate_m <= max(_RATIO * reference.ate_m, _WRONG_SHARE * reference.path_m):
        return "right"
    return "wrong, noted" if says_more else "WRONG, NO NOTE"


def main(words: list[str] | None = None) -> None:
    """Run all seeds and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path("strangers"))
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(20)))
    parser.add_argument("--duration", type=float, default=60.0)
    parser.add_argument("--optvi", action="store_true", help="optimise the maps, too")
    parser.add_argument("--render-only", action="store_true")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args(words)
    rows = []
    for seed in arguments.seeds:
        stranger, folder = rendered(arguments.folder, seed, arguments.duration)
        if arguments.render_only:
            continue
        recording = open_recording(folder, SourceOptions())
        truth = read_trajectory(folder / TRUTH)
        sound = stranger.sound(recording)
        stamps = [int(file.stem) for file in folder.glob("**/cam0/data/*.*") if file.stem.isdigit()]
        stamps_ns = np.array(stamps, dtype=np.int64)
        run_one = functools.partial(
            run, truth=truth, sound=sound.device, stamps_ns=stamps_ns, is_optimised=arguments.optvi
        )
        reference = run_one(sound)
        faulty = run_one(stranger.faulty(recording), shift_s=stranger.shift_s)
        ended = verdict(faulty, reference)
        sys.stdout.write(
            f"{seed:3d} {ended:18} {_figures(faulty, reference)}  [{stranger.words}]\n"
        )
        if faulty.calibration is not None:
            sys.stdout.write(f"      calibration off by {faulty.calibration.words}\n")
        for line in faulty.says:
            sys.stdout.write(f"      {line}\n")
        sys.stdout.flush()
        rows.append({"seed": seed, "ended": ended, "faults": stranger.words,
                     "faulty": dataclasses.asdict(faulty),
                     "reference": dataclasses.asdict(reference)})  # fmt: skip
    _summarise(rows)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


def _figures(faulty: Run, reference: Run) -> str:
    """Return the figures of a run, with those of the true calibration in brackets."""
    figures = (
        ("starts", "start_s", ".2f", "s"), ("covers", "covered", ".2f", ""), ("ATE", "ate_m", ".3f", "m"),
        ("optvi", "optimised_m", ".3f", "m"), ("path", "path_m", ".1f", "m"),
        ("error", "error_px", ".2f", "px"), ("missions", "missions", "d", ""),
    )  # fmt: skip
    return "  ".join(
        f"{words} {getattr(faulty, name):{form}} ({getattr(reference, name):{form}}) {unit}".rstrip()
        for words, name, form, unit in figures
    )


def _summarise(rows: list[dict]) -> None:
    """Print how many runs met the bars."""
    if not rows:
        return
    starts = sum(row["faulty"]["start_s"] <= _START_S for row in rows)
    ratios = [row["faulty"]["ate_m"] / row["reference"]["ate_m"] for row in rows]
    known = [ratio for ratio in ratios if np.isfinite(ratio)]
    silent = sum(row["ended"].isupper() for row in rows)
    sys.stdout.write(
        f"{starts} of {len(rows)} start within {_START_S:g} s; ATE by that of the true calibration: "
        f"median {np.median(known or [np.nan]):.2f}, at most {_RATIO:g} in "
        f"{sum(ratio <= _RATIO for ratio in known)}; without a cause: {silent}\n"
    )


if __name__ == "__main__":
    main()
