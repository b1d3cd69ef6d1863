"""A run over a recording whose first seconds are checked, and that is mended where it does not start."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

from maplab_py.algorithms.recording_check.doctor import (
    Diagnosis,
    check_first_seconds,
    diagnose,
    explain_refusal,
)
from maplab_py.algorithms.recording_check.mending import mended
from maplab_py.errors import EstimationError, MapError
from maplab_py.frontend.mapping import Mapping
from maplab_py.interop.recordings.options import StreamOptions
from maplab_py.interop.recordings.protocol import Recording
from maplab_py.progress import SILENT, Progress

_LEAST_SHARE = 0.5


def run_checked(
    make: Callable[[Recording], Mapping],
    recording: Recording,
    progress: Progress = SILENT,
    *,
    is_to_end: Callable[[], bool] = lambda: False,
    is_repeatable: bool = True,
) -> Mapping:
    """Look at the first seconds, and run; where that fails, mend what is wrong and run again.

    It fails if the odometry does not start, or estimates fewer than half of the frames.

    Args:
        make: Prepares a run over a recording.
        recording: The recording; it is read several times.
        progress: Told of the progress; may cancel.
        is_to_end: Tells whether the user ends the run.
        is_repeatable: A run that has started may be repeated: nobody has used its states.

    Raises:
        UserError: No map can be made of the recording.
        EstimationError: The odometry has not started; says what is wrong with the recording.
    """
    mapping = make(recording)
    error: EstimationError | None = None
    stream = mapping.options.stream
    doubts = check_first_seconds(recording, stream)
    try:
        mapping.run(progress, is_to_end=is_to_end)
    except EstimationError as caught:
        if mapping.is_ended_early:
            raise
        error = caught
    estimated = mapping.statistics.estimated_frames
    is_lost = not mapping.is_ended_early and estimated < _LEAST_SHARE * mapping.statistics.frames
    if error is None and not (is_lost and is_repeatable):
        mapping.statistics.notes.extend(doubts)
        return mapping
    diagnosis = _diagnose(recording, stream, progress)
    again = None
    if diagnosis is not None and mapping.options.odometry.apply_calibration:
        again = mended(recording, diagnosis, stream)
    if again is not None:
        second = make(again)
        with contextlib.suppress(EstimationError):
            second.run(progress, is_to_end=is_to_end)
        if second.statistics.estimated_frames > estimated:
            return second
    if error is not None:
        raise EstimationError(explain_refusal(diagnosis, recording.name, str(error))) from error
    mapping.statistics.notes.extend(doubts)
    return mapping


def _diagnose(recording: Recording, stream: StreamOptions, progress: Progress) -> Diagnosis | None:
    """Diagnose a whole recording; None where a table of it is damaged."""
    try:
        return diagnose(recording, stream, progress=progress)
    except MapError:
        return None
