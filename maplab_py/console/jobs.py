"""Commands in the background: each works on the maps as they were when it started."""

from __future__ import annotations

import dataclasses
import logging
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from maplab_py.console.call import Call
from maplab_py.console.cancellation import CancelToken, obeying
from maplab_py.console.maps import Conflict, MapManager, MapsState, merge_states
from maplab_py.errors import Cancelled, MaplabError, UserError
from maplab_py.progress import Progress
from maplab_py.report import Report

if TYPE_CHECKING:
    from maplab_py.console.session import Session

logger = logging.getLogger(__name__)


class JobProgress:
    """Progress of a job: nobody sees it unless `jobs` asks."""

    def __init__(self, job: Job) -> None:
        """Belong to one job."""
        self._job = job

    def step(self, done: float, total: float, what: str = "") -> None:
        """Remember how far it is; raises Cancelled when the job shall stop."""
        self._job.token.check()
        share = f"{100.0 * done / total:.0f} %" if total > 0 else ""
        self._job.progress = " ".join(filter(None, (what, share)))

    def line(self, text: str) -> None:
        """Drop a line of intermediate result."""

    def check(self) -> None:
        """Raise Cancelled when the job shall stop."""
        self._job.token.check()


class JobTerminal:
    """What a job sees of the terminal: nobody answers, nothing is printed."""

    def __init__(self, job: Job) -> None:
        """Belong to one job."""
        self._job = job

    @property
    def is_interactive(self) -> bool:
        """Nobody is there."""
        return False

    def ask(self, question: str) -> bool:  # noqa: ARG002
        """Answer no."""
        return False

    def show(self, report: Report, command: str) -> None:
        """Show nothing; `join` shows the job's report."""

    def note(self, text: str) -> None:
        """Keep it for `join`."""
        self._job.notes.append(text)

    def progress(
        self,
        command: str,  # noqa: ARG002
        verbosity: int = 0,  # noqa: ARG002
    ) -> AbstractContextManager[Progress]:
        """Return the progress that `jobs` tells of."""
        return nullcontext(JobProgress(self._job))

    def transcribe(self, path: Path | None) -> None:  # noqa: ARG002
        """Refuse: the terminal belongs to the foreground."""
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
    start: float = dataclasses.field(default_factory=time.monotonic)
    seconds: float | None = None  # None while it runs
    report: Report | None = None
    error: BaseException | None = None
    result: MapsState | None = None
    conflicts: tuple[Conflict, ...] = ()
    notes: list[str] = dataclasses.field(default_factory=list)  # said beside the report
    was_told: bool = False  # join has shown its report
    _finished: threading.Event = dataclasses.field(default_factory=threading.Event)
    _settled: threading.Event = dataclasses.field(default_factory=threading.Event)
    _applying: threading.Lock = dataclasses.field(default_factory=threading.Lock)

    @property
    def is_running(self) -> bool:
        """Tell whether it still works."""
        return not self._finished.is_set()

    @property
    def state(self) -> str:
        """Its state in one word."""
        if self.is_running:
            return "cancelling" if self.token.cancelled else "running"
        if isinstance(self.error, Cancelled):
            return "cancelled"
        return "failed" if self.problem else "done"

    @property
    def problem(self) -> str:
        """One line that says why it failed; empty when it did not."""
        if isinstance(self.error, MaplabError):
            return str(self.error)
        if self.error is not None:
            return f"{type(self.error).__name__}: {self.error}"
        return self.report.failure if self.report is not None else ""

    @property
    def elapsed_s(self) -> float:
        """Seconds that it has run."""
        return time.monotonic() - self.start if self.seconds is None else self.seconds

    def cancel(self) -> None:
        """Ask it to stop; it has no effect on the maps from now on."""
        self.token.cancelled = self.token.abandoned = True

    def wait(self, seconds: float | None = None) -> bool:
        """Wait until it is over and the maps have its result; tell whether that has come."""
        return self._settled.wait(seconds)

    def wait_for_work(self, seconds: float) -> bool:
        """Wait until its command has ended; for callers that hold the session's lock."""
        return self._finished.wait(seconds)

    def settle(self, session: Session) -> None:
        """Bring its result into the session's maps once no command of the foreground runs."""
        with session.lock:
            self.apply(session.maps)
        self._settled.set()

    def apply(self, maps: MapManager) -> None:
        """Take its maps over into `maps`, once."""
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
        """Start without jobs; `on_finish` is called in a job's thread when it is over."""
        self._jobs: dict[int, Job] = {}
        self.on_finish: Callable[[Job], None] = lambda _: None

    @property
    def jobs(self) -> list[Job]:
        """All jobs of the session in the order of their start."""
        return list(self._jobs.values())

    @property
    def running(self) -> list[Job]:
        """Those that still run."""
        return [job for job in self.jobs if job.is_running]

    def get(self, number: int) -> Job:
        """Return the job with this number.

        Raises:
            UserError: There is none.
        """
        if number not in self._jobs:
            known = ", ".join(map(str, self._jobs)) or "none"
            raise UserError(f"no job has the number {number} (there are: {known})")
        return self._jobs[number]

    def start(self, session: Session, call: Call, text: str) -> Job:
        """Start a command in the background."""
        job = Job(len(self._jobs) + 1, text, call, session.maps.state)
        self._jobs[job.number] = job

        def body() -> None:
            job.work(session)
            job.settle(session)
            self.on_finish(job)

        threading.Thread(target=body, name=f"job {job.number}", daemon=True).start()
        return job
