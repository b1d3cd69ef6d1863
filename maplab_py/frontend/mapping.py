"""Reading a recording frame by frame: odometry, map building, and what comes of it."""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from typing import Protocol

import numpy as np

from maplab_py.algorithms.recording_check import findings, mending
from maplab_py.array_types import F64
from maplab_py.errors import Cancelled, EstimationError, MaplabError, UserError
from maplab_py.frontend import map_builder, run_options, run_statistics, starting, vertex_keypoints
from maplab_py.frontend.localization import online, record
from maplab_py.frontend.odometry import Odometry
from maplab_py.frontend.odometry_update import OdometryUpdate
from maplab_py.interop.recordings import protocol, stream
from maplab_py.interop.trajectories import Trajectory
from maplab_py.progress import SILENT, Progress

_HEALTH_EVERY_S = 1.0
_STATUS_EVERY_S = 0.25
_ZERO_SAMPLES = 50
"""Samples after which an IMU that measures rates or accelerations only is refused."""
_LONGEST_SLEEP_S = 0.1
"""At a low playback rate, the run looks so often whether it is to end."""


class Observer(Protocol):
    """Sees a run while it goes on, as the viewer does."""

    def after_frame(self, update: OdometryUpdate, mapping: Mapping) -> None:
        """Observe a frame."""


class Mapping:
    """A run over a recording."""

    def __init__(
        self,
        recording: protocol.Recording,
        options: run_options.RunOptions | None = None,
        *,
        observer: Observer | None = None,
        make_starter: starting.MakeStarter | None = None,
        on_estimate: Callable[[OdometryUpdate, Mapping], None] | None = None,
        status: Callable[[], str] = str,
        keeps_states: bool = True,
    ) -> None:
        """Prepare a run.

        Args:
            recording: Recording with an IMU.
            observer: Told of every frame.
            make_starter: See `Odometry`.
            on_estimate: Told of every frame before the map is built, as publishers of poses are.
            status: Returns what the status line says beside the odometry; mostly nothing.
            keeps_states: Keep the state of every frame for `trajectory`; runs of hours need not.

        Raises:
            UserError: The recording has no IMU, a file cannot be used, or a network is not installed.
        """
        self.options = options or run_options.RunOptions()
        self._recording, self._observer, self._status = recording, observer, status
        self._on_estimate = on_estimate
        device, localization = recording.device, self.options.localization
        features = localization.features or self.options.odometry.tracking.descriptor_type
        self._keypoints = vertex_keypoints.VertexKeypoints(
            features, self.options.builder.features_every
        )
        # where the odometry is in a map; None without a map to localise in
        self.localization = online.opened_localization(localization, device, self.options.odometry)
        self.localized = record.LocalizationRecord()  # what it has said of all frames
        # what it has said of the newest frame; None before the first
        self.localized_frame: online.LocalizedFrame | None = None
        is_tight = self.localization is not None and localization.mode == "vil"
        # the recording is read with another calibration than its own
        self.is_mended = isinstance(recording, mending.MendedRecording)
        odometry = self.options.odometry
        # the estimator
        self.odometry = Odometry(
            device,
            odometry.for_doubted() if self.is_mended else odometry,
            make_starter=make_starter,
            map_rule=localization.rule if is_tight else None,
        )
        self.builder: map_builder.MapBuilder | None = None  # the map so far; None without a map
        if self.options.output.run_map_builder:
            self.builder = map_builder.MapBuilder(recording.device, self.options.builder)
        self.stream = stream.EventStream(recording, self.options.stream)
        self.statistics = run_statistics.RunStatistics()  # counts and times
        self.problem = ""  # why the run ended before the end of the recording; empty if it did not
        self.is_ended_early = False  # the user has ended the run before the end of the recording
        # what the map says against the calibration; None if nobody has looked
        self.doubts: tuple[findings.Finding, ...] | None = None
        self._keeps_states = keeps_states
        self._states = array("d")  # time apart, rows of 16 numbers
        self._times_ns = array("q")
        self._mission = -1
        self._told_s = -np.inf
        self._next_status_s = 0.0

    def run(
        self, progress: Progress = SILENT, *, is_to_end: Callable[[], bool] = lambda: False
    ) -> None:
        """Read the recording to its end, to the first error, or until the user ends it.

        Args:
            is_to_end: Tells whether the run is to end now with what it has.

        Raises:
            MaplabError: Nothing has been estimated, and the recording ended or cannot be read.
            Cancelled: The run was cancelled, or ended before anything was estimated.
        """
        self.statistics = run_statistics.RunStatistics(
            zero_ns=self._recording.start_ns, notes=list(self._recording.device.notes)
        )
        try:
            with ThreadPoolExecutor(1, "maplab-images") as thread:
                self._read(thread, progress, is_to_end)
            self.is_ended_early |= is_to_end()  # a live source ends itself
        except Cancelled:
            raise
        except MaplabError as error:
            if not self.statistics.estimated_frames:
                raise
            self.problem = str(error)
        if not self.statistics.estimated_frames:
            if self.is_ended_early:
                raise Cancelled("cancelled")
            raise EstimationError(self._nothing())
        if self.builder is not None:
            backfill = self.odometry.finish_backfill()
            if backfill is not None:
                self.builder.fill(backfill)
            self.builder.missions[-1].refine(self.odometry.window_states())
            self.builder.replace_samples(self.odometry.watch)
        self.odometry.find_calibration()
        estimate = self.odometry.calibration_estimate
        if estimate is None or not estimate.differs or not self.options.odometry.apply_calibration:
            return
        if self.builder is not None:
            self.builder.calibrate(self.odometry.device.with_cameras(*estimate.cameras()))

    def _read(self, thread: Executor, progress: Progress, is_to_end: Callable[[], bool]) -> None:
        """Use the events of the recording; images of files, which need not be waited for, early."""
        is_file = self._recording.end_ns > 0
        for event in stream.read_ahead(self.stream, thread) if is_file else self.stream:
            self._keep_pace(event, is_to_end)
            progress.check()
            if is_to_end():
                self.is_ended_early = True
                break
            for update in self._pushed(event):
                self._take(update, progress)

    def recalibrate(self, device: protocol.RecordedSensors) -> None:
        """Go on with another calibration, of sensors with other ids; see `Odometry.recalibrate`."""
        if self.builder is not None:
            self.builder.missions[-1].refine(self.odometry.window_states())
        self.odometry.recalibrate(device)
        self.statistics.expect_start("another calibration")

    @property
    def recording_notes(self) -> tuple[str, ...]:
        """Notes of the reader of the recording."""
        return self._recording.notes

    def trajectory(self) -> Trajectory:
        """Return the states of all frames as they were estimated at their time, in their mission."""
        rows = np.array(self._states).reshape(-1, 16)
        T_M_I, v_M, gyro_bias, accel_bias = np.split(rows, [7, 10, 13], axis=1)
        times_ns = np.array(self._times_ns, dtype=np.int64)
        return Trajectory(times_ns, T_M_I, v_M, gyro_bias, accel_bias, self._recording.name)

    def _pushed(self, event: protocol.Event) -> list[OdometryUpdate]:
        if isinstance(event, protocol.ImuBatch):
            read = self.stream.statistics
            if read.imu.count >= _ZERO_SAMPLES and read.zero_note:
                raise UserError(f"{self._recording.name}: {read.zero_note}")
            return self.odometry.push_imu(event)
        return self.odometry.push_frames(event)

    def _take(self, update: OdometryUpdate, progress: Progress) -> None:
        """Use the result of a frame."""
        self.statistics.add(update)
        if update.state is not None and self._keeps_states:
            self._times_ns.append(update.time_ns)
            state = update.state
            for column in (state.T_M_I, state.v_M, state.gyro_bias, state.accel_bias):
                self._states.extend(column[0])
        if self.localization is not None:
            self._localize(update, self.localization, progress)
        if self._on_estimate is not None:
            self._on_estimate(update, self)
        if self.builder is not None:
            begin = time.perf_counter()
            self._build(update, self.builder)
            self.statistics.add_stage("map", 1e3 * (time.perf_counter() - begin))
        if update.note.startswith("started again"):
            progress.line(f"{self.statistics.elapsed_s:.1f} s  {update.note}")
        if self.options.enable_health_checking:
            self._tell_health(update, progress)
        self._tell_status(update, progress)
        if self._observer is not None:
            self._observer.after_frame(update, self)

    def _localize(
        self, update: OdometryUpdate, localization: online.OnlineLocalization, progress: Progress
    ) -> None:
        """Find the frame in the map; what goes wrong there does not stop the odometry."""
        had_problem = localization.problem
        frame = localization.after_frame(update, self.odometry.smoother)
        self.localized.add(frame, update)
        self.localized_frame = frame
        self.statistics.add_stage("localise", sum(frame.stage_ms.values()))
        if localization.problem and not had_problem:
            progress.line(f"not localised any more: {localization.problem}")

    def _tell_status(self, update: OdometryUpdate, progress: Progress) -> None:
        """Show the status line, not more often than it can be read."""
        now_s = time.perf_counter()
        if now_s >= self._next_status_s:
            self._next_status_s = now_s + _STATUS_EVERY_S
            words = (
                self.statistics.status_line(update),
                self.odometry.watch.status(),
                self._status(),
            )
            line = "  ".join(filter(None, words))
            progress.step(self.statistics.elapsed_s, self._total_s(), line)

    def _total_s(self) -> float:
        """Return the time up to which the recording is read; 0 = not known."""
        recording, chosen_s = self._recording, self.options.stream.end_s
        known_s = (recording.end_ns - recording.start_ns) * 1e-9 if recording.end_ns else 0.0
        return min(filter(None, (chosen_s, known_s)), default=0.0)

    def _build(self, update: OdometryUpdate, builder: map_builder.MapBuilder) -> None:
        is_between = update.state is None or update.mission != self._mission
        if builder.missions:
            before = builder.missions[-1]
            if update.healthy_until_ns:
                before.drop_after(update.healthy_until_ns)
            before.is_doubtful |= update.has_diverged
            if is_between and update.since_last is not None:
                before.add_imu_after_end(update.since_last.times_ns, update.since_last.accel_gyro)
        if update.state is None:
            self._keep_before_start(update, builder)
            return
        if update.mission != self._mission:
            builder.start_mission(self.odometry.device)
            self._mission = update.mission
        elif update.interval is not None:
            builder.missions[-1].add_imu(update.interval.times_ns, update.interval.accel_gyro)
        if update.released is not None:
            builder.missions[-1].refine(update.released)
        if builder.is_due(update.time_ns):
            covariance = None if update.window is None else update.window.covariance
            builder.add_vertex(update.state, self._keypoints.of(update), update.images, covariance)
        if update.backfill is not None:
            builder.fill(update.backfill)

    def _keep_before_start(self, update: OdometryUpdate, builder: map_builder.MapBuilder) -> None:
        """Keep a frame whose state may be found later."""
        if not self.options.odometry.backfill:
            return
        if update.interval is None:
            builder.forget_before_start()
        if builder.is_due_before_start(update.stamp_ns):
            builder.add_before_start(update.stamp_ns, self._keypoints.of(update), update.images)

    def _tell_health(self, update: OdometryUpdate, progress: Progress) -> None:
        """Print how sure the estimate is."""
        now_s = self.statistics.elapsed_s
        if update.state is None or update.window is None or now_s - self._told_s < _HEALTH_EVERY_S:
            return
        self._told_s = now_s
        sigma: F64 = np.sqrt(np.maximum(np.diagonal(update.window.covariance), 0.0))
        state = update.state
        progress.line(
            f"{now_s:.1f} s  speed {np.linalg.norm(state.v_M):.2f} +- {sigma[6:9].max():.3f} m/s  "
            f"tilt +- {np.degrees(sigma[3:5].max()):.2f} deg  "
            f"gyro bias {np.linalg.norm(state.gyro_bias):.4f} rad/s  "
            f"accel bias {np.linalg.norm(state.accel_bias):.3f} m/s^2  "
            f"error {update.window.median_error_px:.2f} px  {update.motion.value}"
        )

    def _keep_pace(self, event: protocol.Event, is_to_end: Callable[[], bool]) -> None:
        """Wait until an event may be read at the chosen rate, or the run is to end."""
        rate = self.options.realtime_playback_rate
        if not rate or isinstance(event, protocol.ImuBatch) or not self.statistics.frames:
            return
        due_s = (event.time_ns - self.statistics.first_ns) * 1e-9 / rate
        due_s += self.statistics.began_s
        while (left_s := due_s - time.perf_counter()) > 0.0 and not is_to_end():
            time.sleep(min(left_s, _LONGEST_SLEEP_S))

    def _nothing(self) -> str:
        """Say why nothing was estimated."""
        name = self._recording.name
        if not self.statistics.frames:
            if self.stream.statistics.dropped_before_imu:
                return f"{name}: all frames come before the first IMU sample: check the clocks"
            if unmatched := sum(self.stream.statistics.unmatched_images):
                return (
                    f"{name}: none of {unmatched} images has a partner in the other cameras: check the "
                    "trigger, raise --vio_nframe_sync_tolerance_ns, or read one camera "
                    "(--rovio_active_camera_indices=0)"
                )
            return f"{name}: there are no frames: choose another part or other cameras"
        reason = self.statistics.waiting_for or "the recording is too short"
        return f"{name}: the odometry has not started: {reason}"


def load_kernels() -> None:
    """Load the machine code of the odometry, for which the first images of a robot would wait."""
    from maplab_py.estimation.window.warmup import window_jobs
    from maplab_py.frontend import gyroscope
    from maplab_py.frontend.initialization import gyro_bias
    from maplab_py.vision.tracking import tracker

    modules = tracker, gyro_bias, gyroscope
    for load in (*window_jobs().values(), *(module.compile_kernels for module in modules)):
        load()
