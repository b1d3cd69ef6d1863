"""Commands about the session: timing, repetition, transcript, sheep."""

import dataclasses
import time
from pathlib import Path

from maplab_py.cancellation import current_token
from maplab_py.console.scripts.costs import Plan
from maplab_py.plugin import (
    Cancelled,
    CommandContext,
    MaplabError,
    Message,
    Report,
    UserError,
    command,
)
from maplab_py.report import counted


@dataclasses.dataclass(frozen=True)
class TimingLine:
    """The runs of one command."""

    command: str
    runs: int
    total_s: float
    mean_s: float
    longest_s: float


class TimingTable(Report):
    """Time spent in the commands of this session, longest first."""

    timings: tuple[TimingLine, ...]


@command("clear", see_also=("clear_storage",), needs_map=False)
def clear_screen(context: CommandContext) -> Message:
    """Clear the screen; maps stay as they are."""
    context.terminal.clear()
    return Message("")


@command("timing", needs_map=False)
def show_timing(context: CommandContext) -> TimingTable | Message:
    """Show how long the commands of this session took."""
    seconds: dict[str, list[float]] = {}
    for timing in context.session.timings:
        seconds.setdefault(timing.command, []).append(timing.seconds)
    lines = [
        TimingLine(name, len(runs), sum(runs), sum(runs) / len(runs), max(runs))
        for name, runs in seconds.items()
    ]
    if not lines:
        return Message("no command has run yet")
    return TimingTable(tuple(sorted(lines, key=lambda line: -line.total_s)))


@command(
    "watch",
    "w",
    example='watch --command="map_stats" --every=1 --repetitions=2',
    needs_map=False,
    acts_outside=True,
)
def watch(
    context: CommandContext, command: str, *, every: float = 2.0, repetitions: int = 0
) -> Message:
    """Repeat a command until Ctrl-C.

    Args:
        command: The command with its flags, in quotes.
        every: Pause between two runs in seconds.
        repetitions: Number of runs; 0 = until Ctrl-C.
    """
    if not command.strip():
        raise UserError("watch: --command is empty; give the command to repeat")
    if every < 0 or repetitions < 0:
        raise UserError("watch: --every and --repetitions cannot be negative")
    runs = 0
    try:
        while not repetitions or runs < repetitions:
            if runs:
                _sleep(context, every)
            context.session.run_line(command, context.terminal)
            runs += 1
    except Cancelled:
        current_token().cancelled = False  # it is how this command is meant to end
        return Message(f"stopped after {counted(runs, 'run')}")
    return Message(counted(runs, "run"))


@command("check", example="check nightly.maplab", needs_map=False, reads=("script",))
def check(context: CommandContext, script: Path) -> Plan:
    """Check a script without running it, and predict time, memory and disk of each step.

    The predictions rest on former runs of the same commands on this machine, scaled to the maps and
    recordings at hand. A command that was not run yet has none.

    Args:
        script: File of commands.
    """
    from maplab_py.console.scripts import batch, checking, costs

    problems, steps = checking.check_script(batch.read_script(script), context.session)
    if problems:
        raise UserError("; ".join(f"{script}: {problem}" for problem in problems))
    return costs.predict(steps, context.maps)


@command("fix", see_also=("undo",), needs_map=False, acts_outside=True)
def fix(context: CommandContext) -> Message:
    """Run the remedy of the command that was refused last, then that command again.

    A refusal whose remedy is a command says so at the prompt. `maplab --auto_fix` does it in scripts
    without being asked.
    """
    refusal = context.session.refusal
    if refusal is None:
        raise UserError("fix: no command was refused for a reason that another command mends")
    done: list[str] = []
    _run_mended(context, refusal.remedy, {refusal.remedy}, done)
    _run_mended(context, refusal.line, {refusal.remedy}, done)
    return Message(f"{refusal.line} has run after {', '.join(done[:-1])}")


def _run_mended(context: CommandContext, line: str, remedies: set[str], done: list[str]) -> None:
    """Run a line; where it is refused, its remedy first, each remedy once.

    Raises:
        MaplabError: A refusal has no remedy, or one that was tried.
    """
    while True:
        context.progress.line(f"> {line}")
        try:
            context.session.run_line(line, context.terminal)
        except MaplabError as error:
            if not error.remedy or error.remedy in remedies:
                raise
            remedies.add(error.remedy)
            _run_mended(context, error.remedy, remedies, done)
        else:
            done.append(line)
            return


def _sleep(context: CommandContext, seconds: float) -> None:
    """Wait; Ctrl-C ends the wait immediately."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        context.progress.check()
        time.sleep(min(0.05, max(0.0, end - time.monotonic())))
    context.progress.check()


@command("transcript", example="transcript session.txt", needs_map=False, acts_outside=True)
def transcript(context: CommandContext, file: Path | None = None) -> Message:
    """Copy all further input and output to a file.

    Args:
        file: File to append to; empty = stop copying.
    """
    context.terminal.transcribe(file)
    return Message(f"transcript goes to {file}" if file else "transcript ended")


@command("enable_sheep", "sheep", needs_map=False, acts_outside=True)
def enable_sheep(context: CommandContext) -> Message:
    """Show a sheep in the prompt, or remove it again."""
    marks = context.session.marks
    marks["sheep"] = "" if marks.get("sheep") else "\N{SHEEP}"
    return Message("baa")


class NewPlugin(Report):
    """Files of the new package, and the next steps."""

    folder: Path
    files: tuple[str, ...]
    next_steps: tuple[str, ...]


@command(
    "new_plugin",
    example="new_plugin path_lengths",
    see_also=("plugins",),
    needs_map=False,
    writes_files=True,
)
def new_plugin(context: CommandContext, name: str, *, folder: Path | None = None) -> NewPlugin:
    """Create an installable plugin with one command, one test and a README.

    Args:
        name: Name of the plugin and of its first command.
        folder: Folder to create; empty = maplab_NAME in the current folder. It must not exist.
    """
    from importlib.metadata import version

    from maplab_py.console.commands.plugin_template import plugin_files
    from maplab_py.output_files import write_text

    files = plugin_files(name, version("maplab-py"))
    name = name.replace("-", "_")
    if context.session.registry.knows(name):
        raise UserError(f"new_plugin: '{name}' is already a command; give another name")
    target = folder or Path(f"maplab_{name}")
    if target.exists():
        raise UserError(f"new_plugin: {target} exists; give another --folder")
    for path, text in files.items():
        write_text(target / path, [text])
    steps = (f"pip install {target}", f"maplab help {name}", f"pytest {target}/tests")
    return NewPlugin(target, tuple(files), steps)
