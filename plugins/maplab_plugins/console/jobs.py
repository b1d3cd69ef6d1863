"""Commands in the background: list them, wait for them, stop them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING

from maplab_py.plugin import CommandContext, Message, Report, UserError, command

if TYPE_CHECKING:
    from maplab_py.console.jobs import Job


@dataclasses.dataclass(frozen=True)
class JobLine:
    """One command in the background."""

    job: int
    state: str
    elapsed_s: float
    command: str
    progress: str
    problem: str


@dataclasses.dataclass(frozen=True)
class JobList(Report):
    """The background commands of the session."""

    jobs: tuple[JobLine, ...]


@dataclasses.dataclass(frozen=True)
class JoinReport(Report):
    """Background commands that are over, what each of them reported, and where results went."""

    jobs: tuple[JobLine, ...]
    reports: Mapping[str, Report]
    conflicts: tuple[str, ...]

    @property
    def failure(self) -> str:
        """Name the jobs that did not end well."""
        failed = [line for line in self.jobs if line.state != "done"]
        return "; ".join(f"job {line.job} {line.state}: {line.problem}" for line in failed)


@command("jobs", example="jobs", see_also=("join", "cancel"), needs_map=False)
def list_jobs(context: CommandContext) -> JobList | Message:
    """List the commands that run in the background, and those that did.

    A command goes to the background by `&` at its end: `optvi &`. It works on the maps as they are
    at its start. What it makes of them becomes theirs when it ends, and can be taken back by undo.
    If the map has been changed meanwhile, the result becomes a map of its own.
    """
    jobs = context.session.jobs.jobs
    return JobList(tuple(map(_line, jobs))) if jobs else Message("no jobs (see: help jobs)")


@command("join", example="join", see_also=("jobs",), needs_map=False, acts_outside=True)
def join(context: CommandContext, job: int = 0) -> JoinReport | Message:
    """Wait for background commands and show their reports.

    Args:
        job: Number of the job; 0 = all whose report has not been shown yet.
    """
    board = context.session.jobs
    chosen = [board.get(job)] if job else [j for j in board.jobs if not j.was_told]
    if not chosen:
        return Message("no jobs to wait for")
    for each in chosen:
        while not each.wait_for_work(0.05):
            context.progress.check()
    for each in chosen:  # all at once, so that Ctrl-C while waiting loses none
        each.apply(context.maps)
        each.was_told = True
        for note in each.notes:
            context.terminal.note(f"[{each.number}] {note}")
    reports = {f"[{j.number}] {j.call.command.name}": j.report for j in chosen if j.report}
    conflicts = tuple(
        f"'{c.key}' has changed meanwhile; the result of job {j.number} is map '{c.kept_as}'"
        for j in chosen
        for c in j.conflicts
    )
    return JoinReport(tuple(map(_line, chosen)), reports, conflicts)


@command("cancel", example="cancel", see_also=("jobs",), needs_map=False, acts_outside=True)
def cancel(context: CommandContext, job: int = 0) -> Message:
    """Stop background commands; they have no effect on the maps.

    Args:
        job: Number of the job; 0 = all that run.
    """
    board = context.session.jobs
    chosen = [board.get(job)] if job else board.running
    if job and not chosen[0].is_running:
        raise UserError(f"cancel: job {job} is over already")
    if not chosen:
        return Message("no jobs are running")
    for each in chosen:
        each.cancel()
        each.was_told = True
    return Message(f"cancelled: {', '.join(each.text for each in chosen)}")


def _line(job: Job) -> JobLine:
    progress = job.progress if job.is_running else ""
    return JobLine(job.number, job.state, job.elapsed_s, job.text, progress, job.problem)
