"""Commands in the background: list them, wait for them, stop them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING

from maplab_py.plugin import CommandContext, Message, Report, UserError, command

if TYPE_CHECKING:
    from maplab_py.console.session.jobs import Job


@dataclasses.dataclass(frozen=True)
class JobLine:
    """One command in the background."""

    job: int
    state: str
    elapsed_s: float
    command: str
    progress: str
    problem: str


class JobList(Report):
    """The background commands of the session."""

    jobs: tuple[JobLine, ...]


class JoinReport(Report):
    """Finished background commands, their reports, and the keys of their results."""

    jobs: tuple[JobLine, ...]
    reports: Mapping[str, Report]
    conflicts: tuple[str, ...]

    @property
    def failure(self) -> str:
        """Name the jobs that failed or were cancelled."""
        failed = [line for line in self.jobs if line.state != "done"]
        return "; ".join(f"job {line.job} {line.state}: {line.problem}" for line in failed)


@command("jobs", see_also=("join", "cancel"), needs_map=False)
def list_jobs(context: CommandContext) -> JobList | Message:
    """List running and finished background commands.

    A command goes to the background by `&` at its end: `optvi &`. It works on the maps as they are
    at its start. Its result replaces them when it ends, and undo reverts it; if the map has been
    changed in the meantime, the result becomes a separate map.
    """
    jobs = context.session.jobs.jobs
    return JobList(tuple(map(_line, jobs))) if jobs else Message("no jobs (see: help jobs)")


@command("join", see_also=("jobs",), needs_map=False, acts_outside=True, completes={"job": "job"})
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
            if each.step is None:
                context.progress.check()
            else:
                done, total, what = each.step
                context.progress.step(done, total, f"[{each.number}] {what or each.text}")
    for each in chosen:  # all at once, so that Ctrl-C while waiting loses none
        each.apply(context.maps)
        each.was_told = True
        for note in each.notes:
            context.terminal.note(f"[{each.number}] {note}")
    reports = {f"[{j.number}] {j.call.command.name}": j.report for j in chosen if j.report}
    conflicts = tuple(
        f"'{c.key}' changed in the meantime; the result of job {j.number} is map '{c.kept_as}'"
        for j in chosen
        for c in j.conflicts
    )
    return JoinReport(tuple(map(_line, chosen)), reports, conflicts)


@command("cancel", see_also=("jobs",), needs_map=False, acts_outside=True, completes={"job": "job"})
def cancel(context: CommandContext, job: int = 0) -> Message:
    """Stop background commands; they have no effect on the maps.

    A command that reads a recording ends early instead and keeps what it has, as after Ctrl-C. To cancel
    it again discards that, too.

    Args:
        job: Number of the job; 0 = all running jobs.
    """
    board = context.session.jobs
    chosen = [board.get(job)] if job else board.running
    if job and not chosen[0].is_running:
        raise UserError(f"cancel: job {job} has already finished")
    if not chosen:
        return Message("no jobs are running")
    cancelled: list[str] = []
    ending: list[str] = []
    for each in chosen:
        each.was_told = each.cancel()
        (cancelled if each.was_told else ending).append(each.text)
    said = [f"cancelled: {', '.join(cancelled)}"] if cancelled else []
    said += [f"ends with what it has: {', '.join(ending)}"] if ending else []
    return Message("; ".join(said))


def _line(job: Job) -> JobLine:
    progress = job.progress if job.is_running else ""
    return JobLine(job.number, job.state, job.elapsed_s, job.text, progress, job.problem)
