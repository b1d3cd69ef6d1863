"""Runs over recordings: what is made of them, also when they end early."""

import dataclasses
import gc
import time
import tracemalloc
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from maplab_py.array_types import F64
from maplab_py.errors import Cancelled, EstimationError, FlagError, MapError, UserError
from maplab_py.frontend import finishing
from maplab_py.frontend.failures.watch import SensorFailure
from maplab_py.frontend.finishing import _calibration_notes, finish, scale_verdict
from maplab_py.frontend.health import HealthMonitor
from maplab_py.frontend.mapping import Mapping
from maplab_py.frontend.odometry_options import OdometryOptions
from maplab_py.frontend.odometry_update import OdometryUpdate
from maplab_py.frontend.run_options import MapBuilderOptions, OutputOptions, RunOptions
from maplab_py.geometry import so3
from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.interop.recordings.options import StreamOptions
from maplab_py.interop.recordings.protocol import ImuBatch, TrackedFrameSet
from maplab_py.interop.trajectories import read_trajectory
from maplab_py.progress import SilentProgress
from maplab_py.storage.native import load_map
from maplab_py.vimap.comparison import is_same
from maplab_py.vimap.consistency import check_consistency
from maplab_py.vimap.nav_state import NavState
from tests.algorithms.recording_check.faults import with_rig
from tests.frontend.known_start import KnownStart
from tests.frontend.simulated import EditedRecording, position_errors, replayed
from tests.support.own_process import in_own_process


def recording_of(cameras: int = 2) -> tuple[EditedRecording, KnownStart]:
    vi_map, truth = replayed(cameras=cameras)
    plain = MapRecording(vi_map, 0)
    return EditedRecording(plain, tuple(plain.items())), KnownStart(truth, with_biases=True)


def options_of(**output: object) -> RunOptions:
    return RunOptions(output=dataclasses.replace(OutputOptions(), **output))  # type: ignore[arg-type]


class Interrupting(SilentProgress):
    """Ctrl-C at the n-th check."""

    def __init__(self, checks: int) -> None:
        self.left = checks
        self.lines: list[str] = []
        self.steps: list[str] = []

    def check(self) -> None:
        self.left -= 1
        if self.left == 0:
            raise Cancelled("cancelled")

    def line(self, text: str) -> None:
        self.lines.append(text)

    def step(self, done: float, total: float, what: str = "") -> None:
        self.steps.append(what)


def test_a_run_makes_a_map_with_landmarks(tmp_path: Path) -> None:
    recording, start = recording_of()
    folder, poses = tmp_path / "map", tmp_path / "poses.csv"
    options = options_of(save_map_folder=folder, export_estimated_poses_to_csv=poses)
    mapping = Mapping(recording, options, make_starter=start)
    mapping.run()
    finished = finish(mapping, recording.name, map_key="walk")
    report = finished.report
    assert report.failure == ""
    sets = [item for item in recording.items_of if isinstance(item, TrackedFrameSet)]
    assert report.frames == report.estimated_frames == report.vertices == len(sets)
    assert report.missions == 1
    assert 100 < report.good_landmarks <= report.landmarks
    assert [entry.reason for entry in report.starts] == ["beginning of the recording"]
    assert {stage.stage for stage in report.frame_times} > {"window", "all stages"}
    vi_map, _ = load_map(folder)
    assert check_consistency(vi_map).failure == ""
    assert check_consistency(vi_map).warnings == ()
    v = vi_map.vertices
    assert position_errors(start.truth, v.timestamp_ns, v.T_M_I).max() < 0.1
    written = read_trajectory(poses)
    np.testing.assert_array_equal(written.times_ns, v.timestamp_ns)
    assert position_errors(start.truth, written.times_ns, written.T_R_B).max() < 0.1
    assert report.distance_m == pytest.approx(
        np.linalg.norm(np.diff(written.T_R_B[:, 4:], axis=0), axis=1).sum()
    )


def test_equal_runs_give_equal_maps() -> None:
    maps = []
    for _ in range(2):
        recording, start = recording_of(cameras=1)
        mapping = Mapping(recording, make_starter=start)
        mapping.run()
        maps.append(finish(mapping, recording.name).vi_map)
    assert is_same(*maps)


def test_an_error_in_the_recording_keeps_what_came_before(tmp_path: Path) -> None:
    recording, start = recording_of()
    half = recording.items_of[: len(recording.items_of) // 2]
    broken = MapError("cam0/1.png: the image is truncated; copy it again")
    damaged = dataclasses.replace(recording, items_of=(*half, broken))
    mapping = Mapping(damaged, options_of(save_map_folder=tmp_path / "map"), make_starter=start)
    mapping.run()
    finished = finish(mapping, damaged.name)
    assert finished.report.failure == str(broken)
    vi_map, _ = load_map(tmp_path / "map")
    assert len(vi_map.vertices) == sum(isinstance(item, TrackedFrameSet) for item in half)
    assert check_consistency(vi_map).failure == ""


def test_an_error_before_anything_was_estimated_is_raised() -> None:
    recording, start = recording_of()
    damaged = dataclasses.replace(recording, items_of=(MapError("the table is missing"),))
    with pytest.raises(MapError, match="the table is missing"):
        Mapping(damaged, make_starter=start).run()
    with pytest.raises(Cancelled):
        Mapping(recording, make_starter=start).run(Interrupting(1))


def test_a_run_that_is_ended_keeps_what_is_there(tmp_path: Path) -> None:
    recording, start = recording_of()
    options = options_of(save_map_folder=tmp_path / "map", optimize_map_to_localization_map=True)
    mapping = Mapping(recording, options, make_starter=start)
    mapping.run(is_to_end=lambda: mapping.statistics.frames == 30)
    assert mapping.is_ended_early
    finished = finish(mapping, recording.name, is_to_end=lambda: True)
    assert finished.report.failure == ""
    assert finished.report.notes[-1].startswith("ended early: the map is not optimised")
    vi_map, _ = load_map(tmp_path / "map")
    assert len(vi_map.vertices) == finished.report.vertices == 30
    assert check_consistency(vi_map).failure == ""


def test_a_run_that_is_cancelled_saves_nothing(tmp_path: Path) -> None:
    recording, start = recording_of()
    options = options_of(save_map_folder=tmp_path / "map")
    with pytest.raises(Cancelled):
        Mapping(recording, options, make_starter=start).run(Interrupting(60))
    mapping = Mapping(recording, options, make_starter=start)
    mapping.run()
    with pytest.raises(Cancelled):
        finish(mapping, recording.name, progress=Interrupting(1))
    assert not (tmp_path / "map").exists()


def _growth_per_frame() -> float:
    """Return by how much memory grows from frame 45 to frame 75 [bytes per frame]."""
    recording, start = recording_of(cameras=1)
    sizes: dict[int, int] = {}

    class Watch:
        def after_frame(self, update: OdometryUpdate, mapping: Mapping) -> None:
            del update
            if mapping.statistics.frames in (45, 75):
                gc.collect()
                sizes[mapping.statistics.frames] = tracemalloc.get_traced_memory()[0]

    options = options_of(run_map_builder=False)
    tracemalloc.start()
    Mapping(recording, options, make_starter=start, observer=Watch()).run()
    return (sizes[75] - sizes[45]) / 30


def test_memory_does_not_grow_with_the_recording() -> None:
    """Without a map builder a frame leaves 150 bytes; its tracks and samples have many times more."""
    assert in_own_process(_growth_per_frame) < 3000


def test_a_slow_playback_is_ended_without_waiting_for_the_next_frame() -> None:
    recording, start = recording_of(cameras=1)
    options = dataclasses.replace(RunOptions(), realtime_playback_rate=1e-4)
    mapping = Mapping(recording, options, make_starter=start)
    began_s = time.monotonic()
    mapping.run(is_to_end=lambda: mapping.statistics.frames == 1)
    assert mapping.is_ended_early
    assert time.monotonic() - began_s < 60.0  # the second frame is due after 1000 s


def test_a_full_disk_leaves_the_map_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording, start = recording_of(cameras=1)

    def full(*_: object, **__: object) -> None:
        raise UserError("map: cannot be saved (No space left on device)")

    monkeypatch.setattr(finishing, "save_map", full)
    mapping = Mapping(recording, options_of(save_map_folder=tmp_path / "map"), make_starter=start)
    mapping.run()
    finished = finish(mapping, recording.name, map_key="walk")
    assert finished.vi_map is not None
    assert finished.disk_copy is None
    assert finished.report.map_folder is None
    assert "No space left on device" in finished.report.failure
    assert "in memory as 'walk'" in finished.report.failure


def covered(recording: EditedRecording, first: int = 25, last: int = 50) -> EditedRecording:
    """Return a recording whose cameras see nothing for some frames."""
    sets = [item for item in recording.items_of if isinstance(item, TrackedFrameSet)]
    dark = {item.time_ns for item in sets[first:last]}
    items = tuple(
        dataclasses.replace(item, frames=(None, None))
        if isinstance(item, TrackedFrameSet) and item.time_ns in dark
        else item
        for item in recording.items_of
    )
    return dataclasses.replace(recording, items_of=items)


def test_divergence_makes_a_second_mission_and_drops_doubtful_vertices() -> None:
    recording, start = recording_of()
    sets = [item for item in recording.items_of if isinstance(item, TrackedFrameSet)]
    progress = Interrupting(-1)
    mapping = Mapping(covered(recording), make_starter=start)
    mapping.run(progress)
    report = finish(mapping, recording.name).report
    assert report.missions >= 2
    assert report.failure == ""
    assert any("started again" in note for note in report.notes)
    assert any("started again" in line for line in progress.lines)
    assert mapping.builder is not None
    vi_map = mapping.builder.make_map()
    assert check_consistency(vi_map).failure == ""
    first = vi_map.vertices.mission == 0
    assert vi_map.vertices.timestamp_ns[first].max() <= sets[25].time_ns
    assert (
        position_errors(start.truth, vi_map.vertices.timestamp_ns, vi_map.vertices.T_M_I).max()
        < 0.2
    )


def test_missions_after_darkness_are_tied() -> None:
    """The known start gives states in the true frame, so that true base frames are the identity."""
    recording, start = recording_of()
    mapping = Mapping(covered(recording), make_starter=start)
    mapping.run()
    finished = finish(mapping, recording.name)
    vi_map = finished.vi_map
    assert vi_map is not None
    assert vi_map.baseframes.is_known.all()
    edges = vi_map.loop_closure_edges
    assert len(edges) == len(vi_map.missions) - 1 == 1
    assert vi_map.vertices.mission[[edges.from_vertex[0], edges.to_vertex[0]]].tolist() == [0, 1]
    sigma_m = np.sqrt(np.trace(edges.covariance[0, :3, :3]))
    assert np.linalg.norm(vi_map.T_G_M[1, 4:]) < 3.0 * sigma_m < 1.5
    assert abs(vi_map.T_G_M[1, 2]) < 0.01
    assert check_consistency(vi_map).failure == ""
    assert any("mission 2 is tied to mission 1 by " in note for note in finished.report.notes)


def test_a_mission_after_a_wrong_state_is_not_tied() -> None:
    recording, start = recording_of()
    mapping = Mapping(recording, make_starter=start)
    frames = [item for item in recording.items_of if isinstance(item, TrackedFrameSet)]
    middle_ns = frames[len(frames) // 2].time_ns
    problem = HealthMonitor.problem

    def wrong_once(self: HealthMonitor, state: NavState, covariance: F64, tracks: int) -> str:
        text = problem(self, state, covariance, tracks)
        return "speed 30.0 m/s" if state.time_ns[0] == middle_ns else text

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(HealthMonitor, "problem", wrong_once)
        mapping.run()
    finished = finish(mapping, recording.name)
    assert finished.vi_map is not None
    assert len(finished.vi_map.missions) == 2
    assert len(finished.vi_map.loop_closure_edges) == 0
    assert not finished.vi_map.baseframes.is_known.any()
    assert any("mission 2 is not tied" in note for note in finished.report.notes)


def test_a_run_that_never_starts_says_why() -> None:
    recording, _ = recording_of(cameras=1)
    short = dataclasses.replace(recording, items_of=recording.items_of[:20])
    with pytest.raises(EstimationError, match=r"has not started: 0\.\d of 1\.5 s of images"):
        Mapping(short).run()


def test_recordings_without_frames_or_samples() -> None:
    recording, start = recording_of()
    samples = tuple(item for item in recording.items_of if isinstance(item, ImuBatch))
    with pytest.raises(EstimationError, match="there are no frames"):
        Mapping(dataclasses.replace(recording, items_of=samples), make_starter=start).run()
    frames = tuple(i for i in recording.items_of if isinstance(i, TrackedFrameSet))
    early = dataclasses.replace(recording, items_of=(*frames, samples[-1]))
    with pytest.raises(EstimationError, match="before the first IMU sample"):
        Mapping(early, make_starter=start).run()
    empty = dataclasses.replace(recording, items_of=())
    with pytest.raises(MapError, match="the recording is empty"):
        Mapping(empty, make_starter=start).run()


def test_gaps_saturation_and_early_frames_are_reported() -> None:
    recording, start = recording_of(cameras=1)
    items = list(recording.items_of)
    batches = [row for row, item in enumerate(items) if isinstance(item, ImuBatch)]
    for row in batches[20:21]:
        batch = items[row]
        assert isinstance(batch, ImuBatch)
        items[row] = ImuBatch(
            batch.times_ns[-1:], batch.accel_gyro[-1:], np.ones(1, dtype=np.bool_)
        )
    mapping = Mapping(dataclasses.replace(recording, items_of=tuple(items)), make_starter=start)
    mapping.run()
    notes = finish(mapping, recording.name).report.notes
    assert any("intervals between IMU samples are longer" in note for note in notes)
    assert any("1 IMU samples are saturated" in note for note in notes)


def test_frames_after_the_last_sample_are_reported() -> None:
    recording, start = recording_of(cameras=1)
    frames_ns = [i.time_ns for i in recording.items_of if isinstance(i, TrackedFrameSet)]
    items = tuple(
        item
        for item in recording.items_of
        if not isinstance(item, ImuBatch) or item.times_ns[-1] <= frames_ns[-5]
    )
    mapping = Mapping(dataclasses.replace(recording, items_of=items), make_starter=start)
    mapping.run()
    notes = finish(mapping, recording.name).report.notes
    left_out = len(frames_ns) - mapping.statistics.frames
    assert left_out >= 4
    assert f"{left_out} frames after the last IMU sample left out" in notes


def test_without_map_builder_only_poses_are_estimated(tmp_path: Path) -> None:
    recording, start = recording_of(cameras=1)
    poses = tmp_path / "poses.csv"
    options = options_of(run_map_builder=False, export_estimated_poses_to_csv=poses)
    mapping = Mapping(recording, options, make_starter=start)
    mapping.run()
    finished = finish(mapping, recording.name)
    assert finished.vi_map is None
    assert finished.report.vertices == 0
    assert len(read_trajectory(poses)) == finished.report.frames


def test_the_status_line_and_health() -> None:
    recording, start = recording_of()
    progress = Interrupting(-1)
    options = dataclasses.replace(RunOptions(), enable_health_checking=True)
    Mapping(recording, options, make_starter=start).run(progress)
    assert "tracks" in progress.steps[-1]
    assert "landmarks" in progress.steps[-1]
    assert " x real time" in progress.steps[-1]
    assert 5 <= len(progress.lines) <= 10
    assert all("speed" in line and "tilt" in line for line in progress.lines)
    waiting = Interrupting(10)
    with pytest.raises(Cancelled):
        Mapping(recording).run(waiting)
    assert "not started: 0." in waiting.steps[-1]


def test_real_time_playback() -> None:
    recording, start = recording_of(cameras=1)
    options = dataclasses.replace(RunOptions(), realtime_playback_rate=20.0, stream=StreamOptions())
    mapping = Mapping(recording, options, make_starter=start)
    mapping.run()
    assert mapping.statistics.real_time_factor() <= 20.0


@pytest.mark.parametrize(
    ("group", "values", "message"),
    [
        (OutputOptions, {"localization_map_keep_landmark_fraction": 1.5}, "must be .* at most 1"),
        (OutputOptions, {"localization_map_keep_landmark_fraction": 0.5}, "needs --optimize_map"),
        (OutputOptions, {"run_map_builder": False, "save_map_folder": Path("x")}, "needs a map"),
        (
            OutputOptions,
            {"run_map_builder": False, "optimize_map_to_localization_map": True},
            "needs a map",
        ),
        (RunOptions, {"realtime_playback_rate": -1.0}, "must be at least 0"),
        (RunOptions, {"builder": MapBuilderOptions(features_every=5)}, "a network describes"),
        (StreamOptions, {"start_s": -1.0}, "vio_rosbag_start_s"),
    ],
)
def test_wrong_options(group: type, values: dict[str, object], message: str) -> None:
    with pytest.raises(FlagError, match=message):
        group(**values)


@pytest.mark.parametrize(
    ("sigma", "since_s", "doubts", "words"),
    [
        (0.0, None, (), ""),
        (0.04, 4.2, (), "it can be trusted from 4.2 s on"),
        (0.2, None, (), "not known to better than 20 %"),
        (0.04, 4.2, ("lengths are 0.59 times",), "lengths are 0.59 times"),
    ],
)
def test_there_is_one_verdict_on_the_scale(
    sigma: float, since_s: float | None, doubts: tuple[str, ...], words: str
) -> None:
    notes = scale_verdict(sigma, since_s, doubts)
    assert len(notes) == bool(words)
    assert all(words in note for note in notes)


def test_a_map_that_contradicts_its_calibration_is_optimised_with_it_free() -> None:
    recording, start = recording_of()
    wrong = with_rig(recording, turn_deg=(0.0, 1.5, 0.0), move_m=(0.02, 0.0, 0.0))
    mapping = Mapping(wrong, make_starter=start)
    mapping.run()
    failed = SensorFailure(
        "camera 0", "its points do not fit", recording.start_ns, recording.start_ns
    )
    mapping.odometry.watch.failures.append(failed)
    finished = finish(mapping, wrong.name)
    assert finished.vi_map is not None
    device, sensors = recording.device, finished.vi_map.sensors
    T_I_C = sensors.T_I_C(device.imu.id, device.rig.id)
    turned = so3.log(so3.multiply(so3.inverse(device.T_I_C[:, :4]), T_I_C[:, :4]))
    assert np.degrees(np.linalg.norm(turned, axis=1)).max() < 0.3
    (note,) = (line for line in finished.report.notes if "calibration of the cameras free" in line)
    assert "rotation on the IMU" in note
    mapping.odometry.watch.failures[:] = [dataclasses.replace(failed, sensor="gyroscope")]
    assert not any("cameras free" in line for line in finish(mapping, wrong.name).report.notes)
    mapping.odometry.watch.failures.clear()
    kept = dataclasses.replace(OdometryOptions(), apply_calibration=False)
    mapping.options = dataclasses.replace(mapping.options, odometry=kept)
    assert not any("calibration" in line for line in finish(mapping, wrong.name).report.notes)


@pytest.mark.parametrize(
    ("known_s", "offset"), [(0.0, "=25000000 "), (0.004, "=21000000 "), (0.02, "")]
)
def test_the_note_on_a_delay_leaves_out_what_is_in_the_calibration(
    known_s: float, offset: str
) -> None:
    odometry = SimpleNamespace(
        notes=[], calibration_estimate=None, watch=SimpleNamespace(notes=lambda _: [], failures=[]),
        delays=SimpleNamespace(applied_s=0.02, delay_s=0.02, known_s=known_s, sigma_s=1e-4),
        device=SimpleNamespace(cameras=[SimpleNamespace(time_offset_ns=5_000_000)]),
    )  # fmt: skip
    mapping: Any = SimpleNamespace(odometry=odometry, statistics=SimpleNamespace(zero_ns=0))
    notes = _calibration_notes(mapping)
    assert len(notes) == bool(offset)
    assert offset in "".join(notes)
