"""The interactive prompt: history, completion, colours, Ctrl-C and Ctrl-D."""

import datetime as dt
import logging
import os
import shlex
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

from prompt_toolkit import PromptSession
from prompt_toolkit.auto_suggest import AutoSuggestFromHistory
from prompt_toolkit.buffer import Buffer
from prompt_toolkit.completion import CompleteEvent, Completer, Completion
from prompt_toolkit.document import Document
from prompt_toolkit.filters import Condition
from prompt_toolkit.formatted_text import StyleAndTextTuples
from prompt_toolkit.history import FileHistory, History, InMemoryHistory
from prompt_toolkit.input import Input
from prompt_toolkit.input.typeahead import get_typeahead, store_typeahead
from prompt_toolkit.key_binding import KeyPress
from prompt_toolkit.keys import Keys
from prompt_toolkit.lexers import Lexer
from prompt_toolkit.output import ColorDepth
from prompt_toolkit.patch_stdout import patch_stdout
from prompt_toolkit.styles import Style

from maplab_py.console.commands.command import Command
from maplab_py.console.commands.flags import looks_like_flag, resolve_name
from maplab_py.console.commands.lines import Word, scan
from maplab_py.console.commands.registry import Registry
from maplab_py.console.prompt.completion import complete
from maplab_py.console.scripts.checking import LEAVE
from maplab_py.console.scripts.runner import Runner
from maplab_py.console.session.maps import MapEntry
from maplab_py.console.session.paths import recent_maps, state_folder
from maplab_py.console.session.session import Session
from maplab_py.console.session.status import Status
from maplab_py.console.terminal.foreground import NotedInterrupts, interrupts_noted
from maplab_py.console.terminal.render import wants_colour
from maplab_py.errors import Cancelled, FlagError
from maplab_py.report import counted

SHEEP = "sheep"
_logger = logging.getLogger(__name__)
_MAX_NAMES_IN_TOOLBAR = 4
_CTRL_C = (Keys.ControlC, Keys.SIGINT)

_STYLE = Style.from_dict(
    {
        "key": "ansiyellow",
        "unsaved": "ansired bold",
        "sign": "ansigreen",
        "command": "ansicyan bold",
        "unknown": "ansired",
        "flag": "ansiblue",
        "value": "ansigreen",
        "comment": "ansibrightblack",
        "bottom-toolbar": "noreverse ansibrightblack",
        "bottom-toolbar.text": "noreverse ansibrightblack",
    }
)


class CommandCompleter(Completer):
    """Offers the session's candidates to prompt_toolkit."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def get_completions(
        self,
        document: Document,
        complete_event: CompleteEvent,  # noqa: ARG002
    ) -> Iterable[Completion]:
        """Yield the candidates for the text before the cursor."""
        text = document.text_before_cursor
        width = max(20, shutil.get_terminal_size().columns - 40)
        for candidate in complete(text, self._session):
            note = candidate.help
            yield Completion(
                candidate.text,
                start_position=candidate.start - len(text),
                display=candidate.shown,
                display_meta=note if len(note) <= width else note[: width - 1] + "…",
            )


class CommandLexer(Lexer):
    """Colours commands, flags and values; an unknown command is red."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def lex_document(self, document: Document) -> Callable[[int], StyleAndTextTuples]:
        """Return the coloured parts of each line."""
        lines = document.lines

        def line_parts(number: int) -> StyleAndTextTuples:
            parts = coloured_parts(lines[number], self._session.registry)
            return [(f"class:{style}" if style else "", text) for style, text in parts]

        return line_parts


def prompt_parts(session: Session) -> StyleAndTextTuples:
    """Return the prompt: `maplab <key>:/$ `, with `*` when the map has unsaved changes."""
    key = session.maps.selected_key
    parts: StyleAndTextTuples = []
    if session.marks.get(SHEEP):
        parts.append(("class:sign", session.marks[SHEEP] + " "))
    parts += [("", "maplab "), ("class:key", f"<{key}>")]
    if key and not session.maps.selected.is_saved:
        parts.append(("class:unsaved", "*"))
    return [*parts, ("", ":/$ ")]


def toolbar_text(session: Session, columns: int = 0) -> str:
    """Return the line below the prompt: what is selected, unsaved, running and announced.

    Args:
        columns: Width of the terminal; counts are left out where it is too narrow. 0 = any.
    """
    facts: list[str] = []
    counts: list[str] = []  # the first ones are the first to go
    if session.maps.selected_key:
        entry = session.maps.selected
        missions = _missions(entry)
        facts += [f"map {entry.key}", missions]
        counts = [
            counted(len(entry.vi_map.landmarks), "landmark"),
            counted(len(entry.vi_map.vertices), "vertex", "vertices"),
            missions,
        ]
        facts += [*counts[1::-1], "saved" if entry.is_saved else "unsaved"]
        others = len(session.maps) - 1
        facts += [f"{others} other map{'' if others == 1 else 's'}"] if others else []
    running = ", ".join(f"[{job.number}] {job.call.command.name}" for job in session.jobs.running)
    facts += [f"running {running}"] if running else []
    facts += [f"{topic} {text}" for topic, text in session.marks.items() if text and topic != SHEEP]
    for count in counts:
        if not 0 < columns < len(" · ".join(facts)):
            break
        facts.remove(count)
    return " · ".join(facts)


def _missions(entry: MapEntry) -> str:
    """Return the number of missions, with their names if they are few and not the map's."""
    names = [str(name) for name in entry.vi_map.missions.name if name]
    is_short = 0 < len(names) <= _MAX_NAMES_IN_TOOLBAR and names != [entry.key]
    return counted(len(entry.vi_map.missions), "mission") + (
        f": {', '.join(names)}" if is_short else ""
    )


def run_prompt(runner: Runner, first_line: str = "") -> Status:
    """Read and run lines until the user leaves (status 0) or the terminal is closed (status 1).

    Args:
        runner: Runs the lines.
        first_line: Run before the first prompt.
    """
    session = runner.session
    plain = not wants_colour(sys.stdout)
    prompt: PromptSession[str] = PromptSession(
        completer=CommandCompleter(session),
        lexer=None if plain else CommandLexer(session),
        history=_history(),
        auto_suggest=AutoSuggestFromHistory(),
        complete_while_typing=Condition(lambda: session.settings.is_on("complete_while_typing")),
        style=_STYLE,
        color_depth=ColorDepth.DEPTH_1_BIT if plain else None,
        bottom_toolbar=None
        if plain
        else lambda: toolbar_text(session, shutil.get_terminal_size().columns) or None,
        refresh_interval=0 if plain else 1.0,
    )
    runner.terminal.is_prompt = True
    lines = recent_lines(state_folder() / "history")
    session.uses.update(line.split(maxsplit=1)[0] for line in lines)
    session.jobs.on_finish = runner.tell_of_job
    for problem in session.registry.problems:
        runner.terminal.warning(problem)
    try:
        if first_line:
            _run_line(runner, first_line)
        else:
            for text in greeting():
                runner.terminal.note(text)
        return _read_lines(runner, prompt)
    finally:
        session.watchers.close()


def _read_lines(runner: Runner, prompt: PromptSession[str]) -> Status:
    session = runner.session
    with interrupts_noted() as interrupts:
        _note_interrupts_from_enter_on(prompt, interrupts)
        while True:
            try:
                interrupts.is_noted = False
                with patch_stdout(raw=True), _interrupts_as_keys(prompt, interrupts):
                    line = prompt.prompt(lambda: prompt_parts(session))
            except KeyboardInterrupt:
                continue
            except EOFError:
                if not sys.stdin.isatty():
                    return _without_terminal(session)
                runner.wants_exit = True
                line = ""
            if _has_ctrl_c_behind_enter(prompt.input):
                interrupts.is_noted = True
            if line.strip():
                _run_line(runner, line)
            if runner.wants_exit and _may_leave(runner):
                return Status.OK
            runner.wants_exit = False


@contextmanager
def _interrupts_as_keys(prompt: PromptSession[str], interrupts: NotedInterrupts) -> Iterator[None]:
    """Turn Ctrl-C inside into the key, so that a new prompt is drawn.

    The line editor hears it by itself as soon as it runs, but not while the prompt is drawn.
    """
    interrupts.instead = lambda: store_typeahead(prompt.input, [KeyPress(Keys.ControlC)])
    try:
        yield
    finally:
        interrupts.instead = None


def _note_interrupts_from_enter_on(prompt: PromptSession[str], interrupts: NotedInterrupts) -> None:
    """Let Ctrl-C cancel the command as soon as Enter was pressed, while the line editor still ends."""
    accept = prompt.default_buffer.accept_handler
    assert accept is not None

    def accept_line(buffer: Buffer) -> bool:
        interrupts.instead = None
        return accept(buffer)

    prompt.default_buffer.accept_handler = accept_line


def _has_ctrl_c_behind_enter(keyboard: Input) -> bool:
    """Tell whether Ctrl-C was typed behind Enter, while the terminal still took it for a key.

    What was typed before it is dropped, what comes behind it is kept for the next line.
    """
    keys = get_typeahead(keyboard)
    with keyboard.raw_mode():
        keys += keyboard.read_keys()
    at = [number for number, press in enumerate(keys) if press.key in _CTRL_C]
    store_typeahead(keyboard, keys[at[-1] + 1 :] if at else keys)
    return bool(at)


def _run_line(runner: Runner, line: str) -> None:
    """Run a line; Ctrl-C while a report is printed must not end the program."""
    try:
        status = runner.run_text(line)
        runner.session.watchers.after_line(line, succeeded=status is Status.OK)
    except KeyboardInterrupt:
        runner.terminal.error("cancelled")


def _without_terminal(session: Session) -> Status:
    """Tell the log what is lost, since nobody can be asked any more."""
    unsaved = ", ".join(entry.key for entry in session.maps.unsaved)
    _logger.warning("the terminal was closed%s", f"; unsaved changes in {unsaved}" * bool(unsaved))
    return Status.FAILED


def _may_leave(runner: Runner) -> bool:
    """Ask before running jobs or unsaved changes are lost."""
    unsaved = ", ".join(entry.key for entry in runner.session.maps.unsaved)
    running = ", ".join(job.text for job in runner.session.jobs.running)
    questions = [f"still running: {running}; leave and stop it?"] if running else []
    questions += [f"unsaved changes in {unsaved}; leave without saving?"] if unsaved else []
    try:
        return all(runner.terminal.ask(question) for question in questions)
    except Cancelled:
        return False


def _history() -> History:
    """Return the history file in the user's state folder; only memory where none can be written."""
    history, problem = open_history(state_folder() / "history")
    if problem:
        sys.stderr.write(f"warning: the history is not kept: {problem}\n")
    return history


def coloured_parts(line: str, registry: Registry) -> list[tuple[str, str]]:
    """Split a line into (style, text) whose texts joined are the line.

    Styles are command, flag, value, unknown (a command or flag that does not exist) or empty.
    """
    parts: list[tuple[str, str]] = []
    position = 0
    for words in scan(line):
        command: Command | None = None
        for number, word in enumerate(words):
            parts.append(("", line[position : word.start]))
            raw = line[word.start : word.end]
            if number == 0:
                known = registry.knows(word.text)
                command = registry.find(word.text) if known else None
                style = "command" if known or word.text in LEAVE else "unknown"
                parts.append((style, raw))
            else:
                parts += _argument_parts(word, raw, command)
            position = word.end
    parts.append(("", line[position:]))
    return [part for part in parts if part[1]]


def _argument_parts(word: Word, raw: str, command: Command | None) -> list[tuple[str, str]]:
    if not looks_like_flag(word.text) or command is None:
        return [("value", raw)]
    name, equals, value = raw.partition("=")
    style = "flag"
    if not command.raw_arguments:
        try:
            resolve_name(name.lstrip("-"), command.flags, command.name)
        except FlagError:
            style = "unknown"
    return [(style, name + equals), ("value", value)]


_RECENT_BYTES = 100_000
"""Part of the history that the ranking of completions takes into account."""

logger = logging.getLogger(__name__)


class KeptHistory(FileHistory):
    """A history file; a line that cannot be written is kept in memory only."""

    def store_string(self, string: str) -> None:
        """Append a line in one write, completely or not at all."""
        lines = "".join(f"+{line}\n" for line in string.split("\n"))
        data = f"\n# {dt.datetime.now()}\n{lines}".encode()
        try:
            _append(Path(os.fsdecode(self.filename)), data)
        except OSError:
            logger.warning("%s: a line is not kept", self.filename, exc_info=True)


def open_history(path: Path) -> tuple[History, str]:
    """Return a history that is kept in a file, else one in memory and the reason for that."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        with path.open("rb"):
            pass
    except OSError as error:
        return InMemoryHistory(), str(error)
    return KeptHistory(str(path)), ""


def recent_lines(path: Path) -> list[str]:
    """Return the lines at the end of a history file; none if it is unreadable."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - _RECENT_BYTES))
            lines = file.read().decode(errors="replace").splitlines()[1:]
    except OSError:
        return []
    return [line[1:] for line in lines if line[:1] == "+" and line[1:].strip()]


def _append(path: Path, data: bytes) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
    try:
        size = os.fstat(descriptor).st_size
        if os.write(descriptor, data) != len(data):
            os.ftruncate(descriptor, size)
    finally:
        os.close(descriptor)


_MAX_MAPS = 3


def greeting() -> list[str]:
    """Return what the prompt says first: the version, a hint, and the maps that were used last."""
    lines = [f"maplab-py {version('maplab-py')} · help lists tasks and commands · Tab completes"]
    here = Path.cwd()
    maps = [
        path.relative_to(here) if path.is_relative_to(here) and path != here else path
        for path in recent_maps()[:_MAX_MAPS]
    ]
    if maps:
        lines += ["recent maps:", *(f"  load {shlex.quote(str(path))}" for path in maps)]
    return lines
