"""Self-calibration beside a run: segments whose states are final go to a process of low priority."""

import dataclasses
import hashlib
import queue
import threading
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime

import numpy as np

from maplab_py.algorithms.recording_check.mending import RecalibratedRecording
from maplab_py.algorithms.self_calibration.reports import SelfCalibrationReport
from maplab_py.algorithms.self_calibration.segments.database import read_calibration
from maplab_py.child_processes import Service, ServiceEnded
from maplab_py.errors import Cancelled, MaplabError
from maplab_py.frontend.mapping import Mapping
from maplab_py.frontend.odometry_update import OdometryUpdate
from maplab_py.frontend.recorded_mission import RecordedMission
from maplab_py.interop.recordings.protocol import RecordedSensors, Recording, TrackedFrame
from maplab_py.online_calibration.options import OnlineCalibrationOptions
from maplab_py.online_calibration.process import OPTIONS, Finish, Opening, Piece, Status, words
from maplab_py.progress import Progress
from maplab_py.sensors import SensorSet, calibration_transfer

_MODULE = "maplab_py.online_calibration.child"
_SIGNIFICANT_SIGMAS = 3.0
_TIMES_TO_START = 2


class CalibrationBeside:
    """Observes a run, and hands the segments of its map on; frames never wait for it.

    A segment is complete when all its vertices have left the window.
    """

    def __init__(self, options: OnlineCalibrationOptions) -> None:
        """Prepare; the process starts with the first segment."""
        self._options = options
        self._mapping: Mapping | None = None
        self._mission, self._begin_ns, self._session = -1, 0, ""
        self._worker: _Worker | None = None
        self._device: RecordedSensors | None = None  # as segments are recorded now
        self._can_switch = True  # a proposal that cannot be read is not read again
        self._held: Piece | None = None  # the newest segment, while the odometry may still diverge

    def after_frame(self, update: OdometryUpdate, mapping: Mapping) -> None:
        """Hand a segment on when one is complete."""
        if mapping is not self._mapping:  # the first run, or the same recording once more
            self.close()
            self._mapping, self._mission, self._device = mapping, -1, None
            self._can_switch = True
        if update.has_diverged:
            self._held = None
        if self._options.apply == "now":
            self._switch(update, mapping)
        builder = mapping.builder
        if builder is None or update.released is None or not len(update.released):
            return
        if len(builder.missions) - 1 != self._mission:
            self._mission, self._begin_ns = len(builder.missions) - 1, 0
        recorded = builder.missions[self._mission]
        if not self._begin_ns and len(recorded) > 1:
            self._begin_ns = int(recorded.states[0].time_ns[0])
            # clocks may start anew with every recording; samples do not repeat
            samples = hashlib.blake2b(recorded.edges[0][1].tobytes(), digest_size=8)
            self._session = f"{self._begin_ns} {samples.hexdigest()}"
        self._cut(recorded, int(update.released.time_ns[-1]), OPTIONS.segment_keyframes)

    def _cut(self, recorded: RecordedMission, until_ns: int, fewest: int) -> None:
        """Hand on the next segment if it has enough vertices up to a time."""
        first = recorded.row_at(self._begin_ns)
        if first is None:  # it was given up after a divergence
            self._begin_ns = 0
            return
        end = min(first + OPTIONS.segment_keyframes, len(recorded))
        if end - first < fewest or int(recorded.states[end - 1].time_ns[0]) > until_ns:
            return
        part = _without_descriptors(recorded.part(first, end))
        assert self._mapping is not None
        if self._mapping.odometry.watch.has_failed_between(
            self._begin_ns, int(part.states[-1].time_ns[0])
        ):
            self._begin_ns = int(part.states[-1].time_ns[0])
            return
        if self._worker is None:
            self._device = self._mapping.odometry.device
            opening = Opening(self._options, self._device)
            self._worker = _Worker(opening, self._options.processor_share)
        self._hand_on(Piece(self._session, part))
        self._begin_ns = int(part.states[-1].time_ns[0])

    def _hand_on(self, following: Piece | None) -> None:
        """Hand on the segment that was held back, and hold the following one back."""
        if self._worker is not None and self._held is not None:
            self._worker.put(self._held)
        self._held = following

    def _switch(self, update: OdometryUpdate, mapping: Mapping) -> None:
        """Go on with a proposed calibration once the odometry is at a keyframe and sure enough."""
        worker, window = self._worker, update.window
        if not self._can_switch or worker is None or worker.is_opening:
            return
        if (proposal := worker.newest.proposal) is None:
            return
        if window is None or not window.is_keyframe or not mapping.odometry.can_recalibrate:
            return
        assert self._device is not None
        try:
            known = read_calibration(self._options.proposal)
            self._device = _calibrated(self._device, known)
        except MaplabError as error:
            mapping.statistics.notes.append(f"the proposed calibration is not used: {error}")
            self._can_switch = False
            return
        mapping.recalibrate(self._device.renamed())
        reason = contradicted(worker.newest) or "the calibration was not known as well as wanted"
        mapping.statistics.notes.append(
            f"{reason}; a new mission with another calibration since "
            f"{mapping.statistics.elapsed_s:.1f} s: {_changed(proposal)}"
        )
        worker.open_again(Opening(self._options, self._device))

    @property
    def evaluation(self) -> Status:
        """The newest answer of the process."""
        return Status() if self._worker is None else self._worker.newest

    def recalibrated(self, recording: Recording) -> Recording:
        """Return the recording with the calibration that an earlier run has found, if it is to be used.

        Raises:
            UserError: The file is damaged, or of other cameras.
        """
        options, of_recording = self._options, recording.device
        if not options.applies_later or not options.proposal.is_file():
            return recording
        known = read_calibration(options.proposal)
        return RecalibratedRecording(
            recording,
            _calibrated(of_recording, known),
            "read with the calibration that --self_calibrate has found",
        )

    def with_status(self, status: Callable[[], str]) -> Callable[[], str]:
        """Return the status line of others, and what the segments say."""

        def joined() -> str:
            newest = self.evaluation
            said = status(), contradicted(newest), str(newest.missing or "")
            return "  ".join(filter(None, said))

        return joined

    def finish(
        self, mapping: Mapping, progress: Progress, is_to_end: Callable[[], bool] = lambda: False
    ) -> None:
        """Wait for what is left, unless the user wants the end; put notes into the run's report."""
        progress.line("evaluate the last segments of the self-calibration")
        if mapping.builder is not None and self._mapping is mapping and self._begin_ns:
            recorded = mapping.builder.missions[self._mission]
            if recorded.last_ns is not None:
                self._cut(recorded, recorded.last_ns, OPTIONS.segment_keyframes // 2 + 1)
        self._hand_on(None)
        notes = mapping.statistics.notes
        if self._worker is None:
            notes.append("self-calibration: no segment of the recording is long enough")
            return
        notes += _notes(self._worker.finish(is_to_end), self._options)
        self.close()

    def close(self) -> None:
        """End the process; what it has written stays."""
        if self._worker is not None:
            self._worker.close()
        self._worker = self._held = None


class _Worker:
    """A thread that asks the process, segment by segment, within its share of a processor."""

    def __init__(self, opening: Opening, share: float) -> None:
        self.newest = Status()
        self._opening, self._share = opening, share
        self._requests: queue.SimpleQueue[Opening | Piece | Finish | None] = queue.SimpleQueue()
        self._service: Service | None = None
        self._starts, self._is_closed = 0, False
        self.is_opening, self._before = False, 0  # segments before it was opened again
        self._hurry = threading.Event()
        self._thread = threading.Thread(target=self._work, name="self-calibration", daemon=True)
        self._thread.start()

    def open_again(self, opening: Opening) -> None:
        """Begin anew with another calibration of the device, after the requests so far; do not wait."""
        self._opening, self.is_opening = opening, True
        self._requests.put(opening)

    def put(self, request: Piece) -> None:
        """Have a segment evaluated; do not wait."""
        self._requests.put(request)

    def finish(self, is_to_end: Callable[[], bool]) -> Status:
        """Wait for all segments and the last words of the process."""
        self._requests.put(Finish())
        self._requests.put(None)
        self._hurry.set()
        while self._thread.is_alive() and not is_to_end():
            self._thread.join(0.1)
        return dataclasses.replace(self.newest, evaluated=self._before + self.newest.evaluated)

    def close(self) -> None:
        """End thread and process."""
        self._is_closed = True
        self._requests.put(None)
        self._hurry.set()
        self._thread.join()

    def _work(self) -> None:
        try:
            while (request := self._requests.get()) is not None and not self._is_closed:
                before_s, began_s = self.newest.processor_s, time.monotonic()
                self._ask(request)
                spent_s = self.newest.processor_s - before_s
                left_s = spent_s / self._share - (time.monotonic() - began_s)
                if left_s > 0.0:
                    self._hurry.wait(left_s)
        finally:
            if self._service is not None:
                self._service.end()

    def _ask(self, request: Opening | Piece | Finish) -> None:
        """Ask the process; one that has died is started again, and the request is not repeated."""
        try:
            if self._service is None:
                if self._starts >= _TIMES_TO_START:
                    return
                self._starts += 1
                self._service = Service(_MODULE)
                self.newest = self._service.ask(self._opening, lambda: self._is_closed)
            self._before += self.newest.evaluated if isinstance(request, Opening) else 0
            self.newest = self._service.ask(request, lambda: self._is_closed)
        except Cancelled:
            self._service = None
        except (ServiceEnded, OSError) as error:
            self._service = None
            problem = f"the process beside the odometry has {error}"
            self.newest = dataclasses.replace(self.newest, problem=problem, processor_s=0.0)
        finally:
            self.is_opening &= request is not self._opening


def _calibrated(device: RecordedSensors, known: SensorSet) -> RecordedSensors:
    """Return a device with a calibration that has been written.

    Raises:
        UserError: It is of other cameras.
    """
    ids = calibration_transfer.Device(device.imu_id, device.rig_id)
    source = calibration_transfer.corresponding_device(known, ids)
    sensors = calibration_transfer.with_calibration_of(device.sensors, ids, known, source)
    return dataclasses.replace(device, sensors=sensors)


def _without_descriptors(recorded: RecordedMission) -> RecordedMission:
    described = recorded.described()
    recorded.frames = [
        tuple(None if frame is None else _bare(frame) for frame in frames) for frames in described
    ]
    recorded.image_rows = [[-1] * len(frames) for frames in described]
    return recorded


def _bare(frame: TrackedFrame) -> TrackedFrame:
    return dataclasses.replace(
        frame,
        descriptor=np.zeros((len(frame.uv_px), 0), dtype=np.uint8),
        descriptor_size=np.zeros(0, dtype=np.int32),
    )


def contradicted(status: Status) -> str:
    """Return what the data contradict, and since when."""
    if status.contradiction is None:
        return ""
    since = datetime.fromtimestamp(1e-9 * status.contradiction.since_ns, UTC)
    return (
        f"{status.contradiction.family} contradicted since {since:%H:%M:%S} "
        f"({status.contradiction.sigmas:.1f} sigma)"
    )


def _changed(proposal: SelfCalibrationReport) -> str:
    """Return what has changed significantly, in words."""
    estimates = proposal.parameters
    return "; ".join(words(e) for e in estimates if abs(e.change_in_sigmas) > _SIGNIFICANT_SIGMAS)


def _notes(status: Status, options: OnlineCalibrationOptions) -> Iterator[str]:
    yield (
        f"self-calibration: {status.evaluated} segments evaluated, {status.kept} in "
        f"{options.database}, {status.processor_s:.1f} s of processor time"
    )
    if said := contradicted(status):
        missing = str(status.missing or "")
        yield f"{said}; {missing}" if missing else said
    if status.problem:
        yield f"self-calibration: {status.problem}"
    if status.proposal is not None:
        use = (
            "the next run with --self_calibrate begins with it"
            if options.applies_later
            else "apply_calibration or --sc_apply=next_start uses it"
        )
        yield f"proposed calibration in {options.proposal} ({use}): {_changed(status.proposal)}"
        for name in status.proposal.unobservable:
            yield f"not observable, as it was: {name}"
