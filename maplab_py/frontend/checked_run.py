"""A run over a recording that is checked before and after, and mended where its calibration does not fit."""

import contextlib
from collections.abc import Callable

from maplab_py.algorithms.recording_check.doctor import (
    Diagnosis,
    check_first_seconds,
    check_map,
    diagnose,
    explain_refusal,
)
from maplab_py.algorithms.recording_check.mending import MendedRecording, mended
from maplab_py.errors import EstimationError, MapError
from maplab_py.frontend.mapping import Mapping
from maplab_py.interop.recordings.protocol import Recording
from maplab_py.progress import SILENT, Progress

_LEAST_SHARE, _AS_MANY = 0.5, 0.9
"""Shares of the frames: of a run that is not lost, and of those of the first run, for the second to count."""
_READ_AGAIN = "read once more: recording and calibration do not agree"
_READ_AS_GIVEN = "read once more as it is given: with what check_recording finds it does not run"


def run_checked(
    make: Callable[[Recording], Mapping],
    recording: Recording,
    progress: Progress = SILENT,
    *,
    is_to_end: Callable[[], bool] = lambda: False,
    is_repeatable: bool = True,
) -> Mapping:
    """Look at the first seconds, run, and check the map; where something is wrong, mend it and run again.

    Where the first seconds show it, the recording is mended before the run. A run has failed if it does not
    start, or estimates fewer than half of the frames. Figures of noise alone are no reason to run again.

    Args:
        make: Prepares a run over a recording.
        recording: The recording; it is read several times.
        is_to_end: Tells whether the user ends the run.
        is_repeatable: A run that has started may be repeated: nobody has used its states.

    Raises:
        UserError: No map can be made of the recording.
        EstimationError: The odometry has not started; says what is wrong with the recording.
    """
    mapping = make(recording)
    doctor = _Doctor(recording, mapping, progress)
    progress.step(0.0, 0.0, "check the first seconds")
    notes = check_first_seconds(recording, mapping.options.stream)
    first = doctor.mended() if notes else None
    if first is not None:
        mapping = make(first)
    error = _run(mapping, progress, is_to_end)
    is_doubtful = _share(mapping) < _LEAST_SHARE or (first is None and bool(mapping.doubts))
    if not mapping.is_ended_early and (error is not None or (is_repeatable and is_doubtful)):
        again = doctor.mended() if first is None else recording
        if again is not None:
            progress.line(_READ_AGAIN if first is None else _READ_AS_GIVEN)
            second = make(again)
            if _run(second, progress, is_to_end) is None and _is_better(second, mapping):
                return second
    if error is not None:
        if mapping.is_ended_early:
            raise error
        reason = explain_refusal(doctor.diagnosis(), recording.name, str(error))
        raise EstimationError(reason) from error
    mapping.statistics.notes.extend(notes if first is None else ())
    return mapping


def _is_better(second: Mapping, first: Mapping) -> bool:
    """Tell whether a run estimates more frames; where the first is contradicted, about as many will do."""
    if not first.doubts:
        return _share(second) > _share(first)
    is_less_doubtful = len(second.doubts or ()) <= len(first.doubts)
    return is_less_doubtful and _share(second) > _AS_MANY * _share(first)


def _share(mapping: Mapping) -> float:
    """Return the share of the frames whose states a run has estimated."""
    return mapping.statistics.estimated_frames / max(mapping.statistics.frames, 1)


def _run(
    mapping: Mapping, progress: Progress, is_to_end: Callable[[], bool]
) -> EstimationError | None:
    """Run, and check the map; return why it has not started, None if it has."""
    try:
        mapping.run(progress, is_to_end=is_to_end)
    except EstimationError as error:
        return error
    mapping.doubts = ()
    # a sensor that fails contradicts any calibration
    if mapping.builder is not None and not mapping.odometry.watch.failures:
        with contextlib.suppress(EstimationError):  # fewer than two vertices are no map
            mapping.doubts = check_map(mapping.builder.make_map())
    return None


class _Doctor:
    """Diagnoses a whole recording at most once."""

    def __init__(self, recording: Recording, mapping: Mapping, progress: Progress) -> None:
        self._recording, self._options, self._progress = recording, mapping.options, progress
        self._diagnoses: list[Diagnosis | None] = []

    def diagnosis(self) -> Diagnosis | None:
        """Return the diagnosis; None where a table of the recording is damaged."""
        if not self._diagnoses:
            try:
                stream = self._options.stream
                self._diagnoses = [diagnose(self._recording, stream, progress=self._progress)]
            except MapError:
                self._diagnoses = [None]
        return self._diagnoses[0]

    def mended(self) -> MendedRecording | None:
        """Return the recording with what was found, unless the user does not want that."""
        if not self._options.odometry.apply_calibration or (diagnosis := self.diagnosis()) is None:
            return None
        return mended(self._recording, diagnosis, self._options.stream)
