"""Background commands: each works on the maps as they were when it started."""

from __future__ import annotations

import dataclasses
import logging
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from maplab_py.cancellation import CancelToken, obeying
from maplab_py.console.session.call import Call
from maplab_py.console.session.maps import Conflict, MapManager, MapsState, merge_states
from maplab_py.console.session.status import describe
from maplab_py.console.terminal.protocol import SilentTerminal
from maplab_py.errors import Cancelled, UserError
from maplab_py.progress import Progress
from maplab_py.report import Report

if TYPE_CHECKING:
    from maplab_py.console.session.session import Session

logger = logging.getLogger(__name__)


class JobProgress:
    """Progress of a job, shown by the command `jobs`."""

    def __init__(self, job: Job) -> None:
        self._job = job

    def step(self, done: float, total: float, what: str = "") -> None:
        """Store the progress; raises Cancelled if the job has been cancelled."""
        self._job.token.check()
        share = f"{100.0 * done / total:.0f} %" if total > 0 else ""
        self._job.progress = " ".join(filter(None, (what, share)))
        self._job.step = (done, total, what)

    def line(self, text: str) -> None:
        """Discard a line of intermediate results."""

    def check(self) -> None:
        """Raise Cancelled if the job has been cancelled."""
        self._job.token.check()


class JobTerminal(SilentTerminal):
    """Terminal of a job, whose report and notes are shown by `join`."""

    def __init__(self, job: Job) -> None:
        self._job = job

    def note(self, text: str) -> None:
        """Store it for `join`."""
        self._job.notes.append(text)

    def progress(
        self,
        command: str,  # noqa: ARG002
        verbosity: int = 0,  # noqa: ARG002
    ) -> AbstractContextManager[Progress]:
        """Return the progress that `jobs` shows."""
        return nullcontext(JobProgress(self._job))

    def transcribe(self, path: Path | None) -> None:  # noqa: ARG002
        """Refuse: the terminal is used by the foreground."""
        raise UserError("transcript: cannot run in the background")


@dataclasses.dataclass
class Job:
    """One command in the background."""

    number: int
    text: str
    call: Call
    base: MapsState
    token: CancelToken = dataclasses.field(default_factory=CancelToken)
    progress: str = ""
    step: tuple[float, float, str] | None = None  # done, total and what, as last reported
    start: float = dataclasses.field(default_factory=time.monotonic)
    seconds: float | None = None  # None while it runs
    report: Report | None = None
    error: BaseException | None = None
    result: MapsState | None = None
    conflicts: tuple[Conflict, ...] = ()
    notes: list[str] = dataclasses.field(default_factory=list)  # shown with the report
    was_told: bool = False  # join has shown its report
    _finished: threading.Event = dataclasses.field(default_factory=threading.Event)
    _result_taken: threading.Event = dataclasses.field(default_factory=threading.Event)
    _applying: threading.Lock = dataclasses.field(default_factory=threading.Lock)

    @property
    def is_running(self) -> bool:
        """Tell whether it is still running."""
        return not self._finished.is_set()

    @property
    def state(self) -> str:
        """Its state in one word."""
        if self.is_running:
            if self.token.cancelled:
                return "cancelling"
            return "ending" if self.token.is_ending else "running"
        if isinstance(self.error, Cancelled):
            return "cancelled"
        return "failed" if self.problem else "done"

    @property
    def problem(self) -> str:
        """Reason of failure in one line; empty if it did not fail."""
        if self.error is not None:
            return describe(self.error)
        return self.report.failure if self.report is not None else ""

    @property
    def elapsed_s(self) -> float:
        """Run time in seconds."""
        return time.monotonic() - self.start if self.seconds is None else self.seconds

    def cancel(self) -> bool:
        """Ask it to stop; from now on it has no effect on the maps.

        A command that can end early is asked for that first, as by Ctrl-C: it keeps what it has. Returns
        whether the job is cancelled.
        """
        if self.token.request_end():
            return False
        self.token.abandon()
        return True

    def wait(self, seconds: float | None = None) -> bool:
        """Wait until it has finished and its result is in the maps; return whether that is the case."""
        return self._result_taken.wait(seconds)

    def wait_for_work(self, seconds: float) -> bool:
        """Wait until its command has finished; for callers that hold the session's lock."""
        return self._finished.wait(seconds)

    def bring_back(self, session: Session) -> None:
        """Merge its result into the session's maps once no foreground command runs."""
        with session.lock:
            self.apply(session.maps)
        self._result_taken.set()

    def apply(self, maps: MapManager) -> None:
        """Merge its result into `maps`, once."""
        with self._applying:
            if self.result is None or self.token.abandoned:
                return
            maps.state, self.conflicts = merge_states(self.base, self.result, maps.state)
            self.result = None

    def work(self, session: Session) -> None:
        """Run the command; called in the job's thread."""
        try:
            with obeying(self.token):
                self.report, self.result = session.compute(self.call, self.base, JobTerminal(self))
        except BaseException as error:
            self.error = error
            logger.info("job %d: %s", self.number, self.text, exc_info=error)
        self.seconds = time.monotonic() - self.start
        self._finished.set()


class JobBoard:
    """The background jobs of a session."""

    def __init__(self) -> None:
        """Start without jobs; `on_finish` is called in the thread of a finished job."""
        self._jobs: dict[int, Job] = {}
        self.on_finish: Callable[[Job], None] = lambda _: None

    @property
    def jobs(self) -> list[Job]:
        """All jobs of the session in the order of their start."""
        return list(self._jobs.values())

    @property
    def running(self) -> list[Job]:
        """The running jobs."""
        return [job for job in self.jobs if job.is_running]

    def get(self, number: int) -> Job:
        """Return the job with this number.

        Raises:
            UserError: There is none.
        """
        if number not in self._jobs:
            known = ", ".join(map(str, self._jobs)) or "none"
            raise UserError(f"no job has the number {number} (known jobs: {known})")
        return self._jobs[number]

    def start(self, session: Session, call: Call, text: str) -> Job:
        """Start a command in the background."""
        job = Job(len(self._jobs) + 1, text, call, session.maps.state)
        self._jobs[job.number] = job

        def body() -> None:
            job.work(session)
            job.bring_back(session)
            self.on_finish(job)

        threading.Thread(target=body, name=f"job {job.number}", daemon=True).start()
        return job
