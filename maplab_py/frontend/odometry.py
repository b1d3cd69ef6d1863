"""Visual-inertial odometry: IMU samples and images in, states out."""

import collections
import dataclasses
import time

import numpy as np

from maplab_py.array_types import F64, I64, U8
from maplab_py.errors import EstimationError, MapError, UserError
from maplab_py.estimation.linear.threads import single_thread
from maplab_py.estimation.window.calibration import CalibrationEstimate, WindowCalibration
from maplab_py.estimation.window.frame import ImuPart, Motion, WindowFrame
from maplab_py.estimation.window.localized import LocalizedSmoother
from maplab_py.estimation.window.options import MapRule
from maplab_py.estimation.window.smoother import FixedLagSmoother
from maplab_py.frontend import gyroscope, health, image_delay, odometry_options, starting
from maplab_py.frontend.backfill import Backfill, Backfiller
from maplab_py.frontend.failures.watch import SensorWatch
from maplab_py.frontend.imu_buffer import ImuBuffer, ImuInterval
from maplab_py.frontend.initialization import imu_noise, initializer
from maplab_py.frontend.motion import MotionDetector
from maplab_py.frontend.odometry_update import OdometryUpdate
from maplab_py.interop.recordings.protocol import (
    FrameSet,
    ImuBatch,
    RecordedSensors,
    TrackedFrameSet,
)
from maplab_py.vimap.nav_state import NavState
from maplab_py.vision.tracking import replay, tracker, tracks, views

_MAX_WAITING = 200  # frames that may wait for IMU samples
_DELAY_STEP_NS = 2_000_000
"""Largest change of the delay of images from one frame to the next while the window has states."""
_NOISE_TIME_NS = 900_000_000
"""Time after which the samples are compared with the calibrated noise."""


class Odometry:
    """Estimates pose, velocity and biases of a rig of cameras with an IMU.

    Samples and frames are pushed in the order of time. A frame is processed as soon as there is a sample at
    its time or later. When the estimate diverges or samples are missing for too long, the estimator starts
    again with a new mission frame M; updates say so.
    """

    def __init__(
        self,
        device: RecordedSensors,
        options: odometry_options.OdometryOptions | None = None,
        *,
        make_starter: starting.MakeStarter | None = None,
        map_rule: MapRule | None = None,
    ) -> None:
        """Prepare for the sensors of a device.

        Args:
            device: The sensors, with an IMU.
            make_starter: Makes what finds the first state, for drivers that know it from elsewhere;
                None = the state is found from images and samples.
            map_rule: How observations of a map are weighed when the smoother is given some; None =
                it cannot be localised.

        Raises:
            UserError: The device has no IMU, or a mask cannot be used.
        """
        if device.imu is None:
            raise UserError(
                "odometry needs an IMU, and the calibration has none: give its file by "
                "--imu_calibration_file=FILE, or a --sensor_calibration_file with an IMU"
            )
        self.options = options or odometry_options.OdometryOptions()
        self.starts, self.frames_before_imu = 0, 0  # counts
        self._device, self._imu = device, device.imu
        self._make_starter = make_starter or self._initializer
        self._map_rule = map_rule
        self._tracker = tracker.FrameTracker(device.cameras, device.T_I_C, self.options.tracking)
        self._buffer = ImuBuffer()
        self._waiting: collections.deque[FrameSet | TrackedFrameSet] = collections.deque()
        self._newest_ns = -1  # time of the newest frame that was pushed
        self._last_ns: int | None = None  # time of the last frame that was processed
        self._gap_end_ns = -1  # time of the last frame if its samples have a gap
        self._replayed: tracks.TrackedImages | None = None  # tracks of the last frame of a replay
        self._detector = MotionDetector(self.options.rest)
        self._focal_px = min(views.focal_length_px(camera) for camera in device.cameras)
        self._smoother: FixedLagSmoother | None = None
        self._delays: image_delay.DelayMonitor | None = None
        if make_starter is None and self.options.estimates_time_offset:
            self._delays = image_delay.DelayMonitor(device)
        self.watch = SensorWatch(device, device.imu)  # of sensors that fail
        self.notes: list[str] = []  # what is wrong with the calibration
        self._noise_is_open = make_starter is None and self.options.imu_noise == "auto"
        self._delay_ns = 0  # that frames have in addition to the calibrated offset
        states = self.options.window_states
        self._calibration = WindowCalibration.of(device.cameras, device.T_I_C, states)
        self.calibration_estimate: CalibrationEstimate | None = None
        self._backfiller = Backfiller(self._backward_smoother, is_wanted=self.options.backfill)
        self._starter: starting.Starter = self._make_starter(device)
        self._gyro_bias: F64 = np.zeros(3)
        self._newest_turn: tuple[ImuInterval, F64] | None = None
        self._start_again()

    def _initializer(self, device: RecordedSensors) -> starting.Starter:
        return initializer.Initializer(device, self.options.initialization)

    # -- what a driver pushes ---------------------------------------------------------------------

    def push_imu(self, batch: ImuBatch) -> list[OdometryUpdate]:
        """Take IMU samples; return the updates of frames that have waited for them.

        Raises:
            MapError: Times do not increase, a value is not a number, or an image cannot be read.
        """
        self._buffer.push(batch)
        return self._process_waiting()

    def push_frames(self, frame_set: FrameSet | TrackedFrameSet) -> list[OdometryUpdate]:
        """Take the images of a frame set, or tracked keypoints; return updates, mostly its own.

        Raises:
            MapError: Times do not increase, there are no IMU samples, or an image cannot be read.
        """
        if frame_set.time_ns <= self._newest_ns:
            raise MapError(
                f"the frame at {frame_set.time_ns} ns does not come after the frame at "
                f"{self._newest_ns} ns: send frames in the order of their stamps, each once"
            )
        self._newest_ns = frame_set.time_ns
        self._waiting.append(frame_set)
        updates = self._process_waiting()
        if len(self._waiting) > _MAX_WAITING:
            raise MapError(
                f"there are {len(self._waiting)} frames after the last IMU sample: check that the "
                "IMU is recorded, and that the clocks of cameras and IMU agree"
            )
        return updates

    @property
    def waiting_frames(self) -> int:
        """Number of frames that wait for IMU samples."""
        return len(self._waiting)

    @property
    def smoother(self) -> FixedLagSmoother | None:
        """The estimator of the window; None while the odometry initialises."""
        return self._smoother

    @property
    def device(self) -> RecordedSensors:
        """The sensors, with figures of noise that are used."""
        return self._device

    @property
    def delays(self) -> image_delay.DelayMonitor | None:
        """Delay of the images that shows in the recording; None where it is not looked for."""
        return self._delays

    @property
    def scale_knowledge(self) -> tuple[float, int | None]:
        """Deviation of this mission's scale when it was looked at last; time since when it is known."""
        return self._backfiller.scale_sigma, self._backfiller.trusted_ns

    @property
    def can_recalibrate(self) -> bool:
        """Whether the estimate is sure enough for another calibration."""
        is_plain = self._map_rule is None and not len(self._calibration)
        return self._smoother is not None and is_plain and self._backfiller.is_idle

    def recalibrate(self, device: RecordedSensors) -> None:
        """If `can_recalibrate`, go on with another calibration, as a new mission in the same frame M."""
        assert device.imu is not None and self._smoother is not None  # noqa: PT018
        self._device, self._imu = device, device.imu
        rig = device.cameras, device.T_I_C
        self._focal_px = min(views.focal_length_px(camera) for camera in device.cameras)
        self._calibration = WindowCalibration.of(*rig)
        self._tracker.recalibrate(*rig)
        self.watch.recalibrate(device, self._imu)
        if self._delays is not None:
            self._delays.recalibrate(device)
        self._smoother.recalibrate(*rig, self._imu)
        self._gyro_bias, self._newest_turn = self._smoother.states.gyro_bias[-1], None
        self.starts += 1

    def finish_backfill(self) -> Backfill | None:
        """Read the frames before the start to their end; None when there are none left."""
        return self._backfiller.finish(self._smoother)

    def landmarks(self) -> tuple[I64, F64]:
        """Return track ids (L,) and places (L, 3) in M of the landmarks in the window."""
        nothing = np.zeros(0, dtype=np.int64), np.zeros((0, 3))
        return nothing if self._smoother is None else self._smoother.landmarks()

    def window_states(self) -> NavState:
        """Return the present estimates of the frames in the window."""
        smoother = self._smoother
        if smoother is None:
            return NavState.stack([])
        states = smoother.states
        return NavState.of_motion(smoother.times_ns, states.T_M_I, states.motion)

    # -- frames -----------------------------------------------------------------------------------

    def _process_waiting(self) -> list[OdometryUpdate]:
        updates = []
        while self._waiting and self._buffer.covers(
            self._waiting[0].time_ns + max(self._delay_ns, self._wanted_delay_ns)
        ):
            frame_set = self._waiting.popleft()
            first_ns = self._buffer.first_ns
            if first_ns is not None and frame_set.time_ns + self._delay_ns < first_ns:
                self.frames_before_imu += 1
                continue
            updates.append(self._process(frame_set))
        return updates

    @property
    def _wanted_delay_ns(self) -> int:
        return 0 if self._delays is None else round(self._delays.applied_s * 1e9)

    @property
    def _delay_s(self) -> float:  # of frames, as far as the calibration of the window includes it
        delays = None if len(self._calibration) else self._delays
        return 1e-9 * self._delay_ns - (0.0 if delays is None else delays.unknown_s)

    def _apply_delay(self) -> None:
        """Change the delay of frames: at once before the start, in small steps after it."""
        if not (change_ns := self._wanted_delay_ns - self._delay_ns):
            return
        if self._smoother is not None:
            self._delay_ns += int(np.clip(change_ns, -_DELAY_STEP_NS, _DELAY_STEP_NS))
            return
        self._delay_ns += change_ns
        self._detector.reset()
        self._backfiller.waiting.delay(change_ns, self._buffer.samples, self._delay_s)
        if isinstance(self._starter, initializer.Initializer):
            self._starter.replace_frames(self._backfiller.waiting.frames)
        if self._last_ns is not None:
            self._last_ns += change_ns

    def _process(self, frame_set: FrameSet | TrackedFrameSet) -> OdometryUpdate:
        note = ""
        interval = since_last = None
        self._apply_delay()
        time_ns = frame_set.time_ns + self._delay_ns
        if self._last_ns is None:
            self._buffer.forget_before(time_ns)
        else:
            interval = since_last = self._buffer.cut(self._last_ns, time_ns)
            if interval.largest_step_ns > self.options.max_imu_gap_s * 1e9:
                note = self._in_gap(interval)
                interval = None
            else:
                self._gap_end_ns = -1
        self._last_ns = time_ns
        measured, failed = interval, ImuPart(0)
        if interval is not None:
            interval, failed = self.watch.usable(interval, self._smoother)
        tracked, images = self._tracked(frame_set, interval, failed)
        tracked = self.watch.without_failed(tracked)
        motion = Motion.MOVING
        if interval is not None:
            motion = self._detector.classify(
                interval, tracked, turn_rad=self._turn_rad(interval), speed_mps=self._speed_mps,
                visible_mps=self._visible_mps(),
            )  # fmt: skip
            if failed and motion is Motion.RESTING:
                motion = Motion.MOVING
        update = OdometryUpdate(
            time_ns=time_ns,
            stamp_ns=frame_set.time_ns,
            mission=self.starts - 1,
            tracked=tracked,
            motion=motion,
            interval=interval,
            stage_ms=dict(tracked.stage_ms),
            note=note,
            images=images,
            tracks=frame_set if isinstance(frame_set, TrackedFrameSet) else None,
            since_last=since_last,
        )
        if self._gap_end_ns >= 0:
            return update
        frame = dataclasses.replace(update.window_frame(), delay_s=self._delay_s, failed=failed)
        has_new_delay = self._measure_delay(update, frame)
        if self._smoother is not None:
            update = self._smoothed(update, frame, self._smoother)
            if self._smoother is not None and measured is not None:
                begin = time.perf_counter()
                self.watch.compare(frame, measured, self._smoother)
                update.stage_ms["compare"] = 1e3 * (time.perf_counter() - begin)
            return update
        self._backfiller.waiting.push(update.stamp_ns, frame, self._buffer.samples)
        self._check_noise()
        if has_new_delay:
            return dataclasses.replace(update, note="the images have other times than their stamps")
        return self._initialised(update, frame)

    def _check_noise(self) -> None:
        """Once there are enough samples, doubt figures of noise that they contradict."""
        frames = self._backfiller.waiting.frames
        if not self._noise_is_open or frames[-1].time_ns - frames[0].time_ns < _NOISE_TIME_NS:
            return
        self._noise_is_open = False
        self._imu, notes = imu_noise.plausible_noise(self._imu, *self._backfiller.waiting.samples())
        if notes:
            self.notes += notes
            self._device = self._device.with_sensor(self._imu)
            self._starter = self._make_starter(self._device)
            if isinstance(self._starter, initializer.Initializer):
                self._starter.replace_frames(frames[:-1])

    def _measure_delay(self, update: OdometryUpdate, frame: WindowFrame) -> bool:
        """Look for a delay of the images; return whether another is to be applied."""
        if self._delays is None or update.tracks is not None:
            return False
        begin = time.perf_counter()
        has_new_delay = self._delays.push(frame)
        update.stage_ms["delay"] = 1e3 * (time.perf_counter() - begin)
        return has_new_delay

    def _in_gap(self, interval: ImuInterval) -> str:
        """Start again at a frame inside or after a gap of the IMU; return a note at the first of them."""
        is_first = self._gap_end_ns < 0
        self._gap_end_ns = int(interval.times_ns[-1])
        note = self._start_again(f"no IMU samples for {interval.largest_step_ns * 1e-9:.2f} s")
        return note if is_first else "waiting for the end of the gap between IMU samples"

    def _tracked(
        self, frame_set: FrameSet | TrackedFrameSet, interval: ImuInterval | None, failed: ImuPart
    ) -> tuple[tracks.TrackedImages, tuple[U8, ...]]:
        """Return the tracks of a frame set, and its images if it has some."""
        is_usable = interval is not None and ImuPart.GYROSCOPE not in failed
        R_I0_I1 = self._turn_in(interval) if interval and is_usable else None
        if isinstance(frame_set, TrackedFrameSet):
            self._replayed = replay.tracked_images_of(
                frame_set, self._replayed, self._device.cameras, self._device.T_I_C, R_I0_I1,
                self.options.tracking,
            )  # fmt: skip
            return self._replayed, ()
        begin = time.perf_counter()
        images = tuple(image.grey() for image in frame_set.images)
        read_ms = 1e3 * (time.perf_counter() - begin)
        begin = time.perf_counter()
        if self._smoother is not None:
            is_moving = interval is not None and self._detector.is_moving(
                interval, self._turn_rad(interval)
            )
            self.watch.look(frame_set.time_ns, images, is_moving=is_moving)
        self._tracker.leave_out(self.watch.left_out)
        look_ms = 1e3 * (time.perf_counter() - begin)
        tracked = self._tracker.track(frame_set.time_ns, images, R_I0_I1)
        stage_ms = {"read": read_ms, "watch": look_ms, **tracked.stage_ms}
        return dataclasses.replace(tracked, stage_ms=stage_ms), images

    def _turn_rad(self, interval: ImuInterval) -> float:
        """Return the angle of a turn, 0 while the gyroscope's bias is not known."""
        return 0.0 if self._smoother is None else gyroscope.turn_angle_rad(self._turn_in(interval))

    def _turn_in(self, interval: ImuInterval) -> F64:
        """Return the turn (3, 3) in an interval; the newest one is kept."""
        if self._newest_turn is None or self._newest_turn[0] is not interval:
            self._newest_turn = interval, gyroscope.turn(self._imu, interval, self._gyro_bias)
        return self._newest_turn[1]

    def _visible_mps(self) -> float:
        """Return the speed at which the landmarks of the window would surely be seen to move."""
        depth_m = np.inf if self._smoother is None else self._smoother.median_depth_m
        return self._detector.visible_mps(depth_m, self._focal_px)

    def _initialised(self, update: OdometryUpdate, frame: WindowFrame) -> OdometryUpdate:
        """Offer the frame to the initialisation; start the smoother when it succeeds."""
        begin = time.perf_counter()
        start = self._starter.push(frame)
        update.stage_ms["initialise"] = 1e3 * (time.perf_counter() - begin)
        if start is None:
            return dataclasses.replace(update, note=update.note or self._starter.reason)
        begin = time.perf_counter()
        try:
            state = self._started(start)
        except EstimationError as error:
            return dataclasses.replace(update, note=self._start_again(str(error)))
        update.stage_ms["window"] = 1e3 * (time.perf_counter() - begin)
        self.starts += 1
        self._gyro_bias = state.gyro_bias[0]
        self._speed_mps = float(np.linalg.norm(state.v_M[0]))
        return dataclasses.replace(update, mission=self.starts - 1, interval=None, state=state)

    def _started(self, start: starting.Start) -> NavState:
        """Start the smoother, and add the frames that have come since; return the newest state."""
        smoother = self._new_smoother()
        smoother.start(start.frame, start.state)
        newest: NavState = start.state
        later = []
        for frame in start.later:
            # without biases and speed, turning and resting could not be told apart
            newest = smoother.add(dataclasses.replace(frame, motion=Motion.MOVING)).state
            later.append(newest)
        self._smoother = smoother
        self._health = health.HealthMonitor(self.options.health)
        self._backfiller.start(start, newest, later)
        return newest

    def _advance_backfill(self, update: OdometryUpdate) -> OdometryUpdate:
        """Read some frames backwards; return the update with their states at the end."""
        if not self._backfiller.is_reading:
            return update
        begin = time.perf_counter()
        with single_thread():
            backfill = self._backfiller.advance()
        update.stage_ms["backfill"] = 1e3 * (time.perf_counter() - begin)
        return dataclasses.replace(update, backfill=backfill)

    def _backward_smoother(self) -> FixedLagSmoother:
        """Return a smoother for frames before the start, with what is known of the calibration now."""
        device, values = self._device, self._calibration.mean
        if self._smoother is not None:
            values = self._smoother.states.calibration
        return FixedLagSmoother(
            device.cameras, device.T_I_C, self._imu, self.options.window,
            self._calibration.reversed_at(values),
        )  # fmt: skip

    def _new_smoother(self) -> FixedLagSmoother:
        rig = self._device.cameras, self._device.T_I_C, self._imu, self.options.window
        calibration = self._calibration.with_delay(1e-9 * self._delay_ns)
        if self._map_rule is None:
            return FixedLagSmoother(*rig, calibration)
        return LocalizedSmoother(*rig, self._map_rule, calibration)

    def find_calibration(self) -> None:
        """Keep what the window says of the calibration now, for the report and the next start."""
        if self._smoother is None or not len(self._calibration):
            return
        self.calibration_estimate = estimate = CalibrationEstimate(
            self._calibration, self._smoother.states.calibration,
            self._smoother.calibration_sigma(), 1e-9 * self._delay_ns,
        )  # fmt: skip
        self._calibration = dataclasses.replace(self._calibration, mean=estimate.values)

    def _smoothed(
        self, update: OdometryUpdate, frame: WindowFrame, smoother: FixedLagSmoother
    ) -> OdometryUpdate:
        """Add the frame to the window; start again if the estimate diverges."""
        begin = time.perf_counter()
        try:
            result = smoother.add(frame)
            tracked = sum(int((c.num_frames > 1).sum()) for c in update.tracked.cameras)
            problem = self._health.problem(result.state, result.covariance, tracked)
        except EstimationError as error:
            problem = str(error)
        update.stage_ms["window"] = 1e3 * (time.perf_counter() - begin)
        if problem:
            healthy_until_ns, is_blind = self._health.healthy_until_ns, self._health.is_blind
            return dataclasses.replace(
                update, interval=None, note=self._start_again(problem),
                healthy_until_ns=healthy_until_ns, has_diverged=not is_blind,
            )  # fmt: skip
        self._gyro_bias = result.state.gyro_bias[0]
        self._speed_mps = float(np.linalg.norm(result.state.v_M))
        self._backfiller.check_scale(smoother, update.stamp_ns, frame, self._buffer.samples)
        return dataclasses.replace(
            self._advance_backfill(update),
            state=result.state,
            released=result.released,
            window=result,
        )

    def _start_again(self, reason: str = "") -> str:
        """Forget all estimates and tracks but the calibration's; return the reason as a note."""
        self._smoother = None
        self._health = health.HealthMonitor(self.options.health)
        self._starter = self._make_starter(self._device)
        self._gyro_bias = np.zeros(3)
        self._speed_mps = 0.0
        self._tracker.reset()
        self._replayed = None
        self._detector.reset()
        self._backfiller.reset()
        self.watch.restart(self._last_ns or 0)
        if self._delays is not None:
            self._delays.reset()
        return f"started again: {reason}" if reason else ""
