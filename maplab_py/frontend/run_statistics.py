"""Counts and times of a run over a recording."""

from __future__ import annotations

import dataclasses
import time
from array import array

import numpy as np

from maplab_py import kernel_cache
from maplab_py.frontend.odometry_update import OdometryUpdate
from maplab_py.frontend.reports import EstimatorStart, StageTime

_GROUPS = {
    "read": "read",
    "watch": "tracking",
    "prepare": "tracking",
    "flow": "tracking",
    "outliers": "tracking",
    "stereo": "tracking",
    "detect": "tracking",
    "tracks": "tracking",
    "initialise": "initialise",
    "delay": "initialise",
    "backfill": "initialise",
    "window": "window",
    "compare": "window",
    "localise": "localise",
    "map": "map",
}
"""Stages of the report by the parts that they consist of."""
_STAGES = tuple(dict.fromkeys(_GROUPS.values()))
_RECENT = 20
"""Frames over which the status line takes medians."""


@dataclasses.dataclass(eq=False)
class RunStatistics:
    """Counts and times of the frames of a run."""

    frames: int = 0
    estimated_frames: int = 0
    zero_ns: int = 0  # beginning of the recording; 0 = the first frame
    first_ns: int = 0
    last_ns: int = 0
    distance_m: float = 0.0
    starts: list[EstimatorStart] = dataclasses.field(default_factory=list)
    notes: list[str] = dataclasses.field(default_factory=list)
    stage_ms: array[float] = dataclasses.field(default_factory=lambda: array("f"))  # frame by frame
    began_s: float = dataclasses.field(default_factory=time.perf_counter)
    compilation_s: float = dataclasses.field(default_factory=kernel_cache.seconds)  # before
    waiting_for: str = ""  # why the estimator does not start
    _reason: str = "beginning of the recording"
    _lost_ns: int = 0
    _last_p: tuple[int, np.ndarray] | None = None

    @property
    def duration_s(self) -> float:
        """Time from the first to the last frame."""
        return (self.last_ns - self.first_ns) * 1e-9

    @property
    def elapsed_s(self) -> float:
        """Time from the beginning of the recording to the last frame."""
        return self._after_zero(self.last_ns)

    def add(self, update: OdometryUpdate) -> None:
        """Count one frame."""
        if not self.frames:
            self.first_ns = self._lost_ns = update.time_ns
        self.frames, self.last_ns = self.frames + 1, update.time_ns
        spent_ms = dict.fromkeys(_STAGES, 0.0)
        for part, spent in update.stage_ms.items():
            spent_ms[_GROUPS[part]] += spent
        self.stage_ms.extend(spent_ms.values())
        if update.note.startswith("started again: "):
            self._reason, self._lost_ns = (
                update.note.removeprefix("started again: "),
                update.time_ns,
            )
            self.notes.append(f"at {self._after_zero(update.time_ns):.2f} s {update.note}")
        self.waiting_for = "" if update.state is not None else update.note
        if update.state is None:
            return
        self.estimated_frames += 1
        if update.mission == len(self.starts):
            waited_s = (update.time_ns - self._lost_ns) * 1e-9
            start = EstimatorStart(self._after_zero(update.time_ns), waited_s, self._reason)
            self.starts.append(start)
        p = update.state.T_M_I[0, 4:]
        if self._last_p is not None and self._last_p[0] == update.mission:
            self.distance_m += float(np.linalg.norm(p - self._last_p[1]))
        self._last_p = update.mission, p

    def expect_start(self, reason: str) -> None:
        """Count the next mission as one that begins for a reason, without a wait."""
        self._reason, self._lost_ns = reason, self.last_ns

    def add_stage(self, stage: str, spent_ms: float) -> None:
        """Count the time of a stage that follows the odometry."""
        self.stage_ms[_STAGES.index(stage) - len(_STAGES)] += spent_ms

    def status_line(self, update: OdometryUpdate) -> str:
        """Return time, real-time factor, tracks and landmarks in one line, the dispensable last.

        The factor is that of the recent frames, whose medians leave out compilation.
        """
        tracks = sum(len(camera) for camera in update.tracked.cameras)
        parts = [f"{self.elapsed_s:.1f} s"]
        if self.frames > _RECENT:
            frame_ms = 1e3 * self.duration_s / (self.frames - 1)
            recent = np.asarray(self.stage_ms[-_RECENT * len(_STAGES) :]).reshape(-1, len(_STAGES))
            spent_ms = max(float(np.median(recent.sum(axis=1))), 1e-3)
            parts.append(f"{frame_ms / spent_ms:.2g} x real time")
        if update.state is None:
            parts.append(f"not started: {update.note}" if update.note else "not started")
        parts.append(f"{tracks} tracks")
        if update.window is not None:
            parts.append(f"{update.window.num_landmarks} landmarks")
        return "  ".join(parts)

    def stages(self) -> tuple[StageTime, ...]:
        """Return median and 99th percentile of each stage over all frames."""
        table = np.asarray(self.stage_ms, dtype=np.float64).reshape(-1, len(_STAGES))
        if not len(table):
            return ()
        used = [name for name, column in zip(_STAGES, table.T, strict=True) if column.any()]
        columns = {name: table[:, _STAGES.index(name)] for name in used}
        columns["all stages"] = table.sum(axis=1)
        return tuple(
            StageTime(name, float(np.median(values)), float(np.percentile(values, 99)))
            for name, values in columns.items()
        )

    def real_time_factor(self) -> float:
        """Return the duration of the recording per elapsed time, compilation left out."""
        compilation_s = kernel_cache.seconds() - self.compilation_s
        return self.duration_s / max(time.perf_counter() - self.began_s - compilation_s, 1e-9)

    def _after_zero(self, time_ns: int) -> float:
        return (time_ns - (self.zero_ns or self.first_ns)) * 1e-9
