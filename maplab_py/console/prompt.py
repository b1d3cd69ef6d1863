"""The interactive prompt: history, completion, colours, Ctrl-C and Ctrl-D."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterable

from prompt_toolkit import PromptSession
from prompt_toolkit.auto_suggest import AutoSuggestFromHistory
from prompt_toolkit.completion import CompleteEvent, Completer, Completion
from prompt_toolkit.document import Document
from prompt_toolkit.formatted_text import StyleAndTextTuples
from prompt_toolkit.history import FileHistory, History, InMemoryHistory
from prompt_toolkit.lexers import Lexer
from prompt_toolkit.output import ColorDepth
from prompt_toolkit.patch_stdout import patch_stdout
from prompt_toolkit.styles import Style

from maplab_py.console.colouring import coloured_parts
from maplab_py.console.completion import complete
from maplab_py.console.paths import state_folder
from maplab_py.console.render import wants_colour
from maplab_py.console.runner import Runner
from maplab_py.console.session import Session
from maplab_py.console.status import Status
from maplab_py.errors import Cancelled

SHEEP = "sheep"

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
        """Complete for one session."""
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
        """Colour for one session."""
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


def toolbar_text(session: Session) -> str:
    """Return the line below the prompt: what is selected, unsaved, running and announced."""
    facts = []
    if session.maps.selected_key:
        entry = session.maps.selected
        missions, landmarks = len(entry.vi_map.missions), len(entry.vi_map.landmarks)
        facts += [
            f"map {entry.key}",
            f"{missions} mission{'' if missions == 1 else 's'}",
            f"{len(entry.vi_map.vertices)} vertices",
            f"{landmarks} landmarks",
            "saved" if entry.is_saved else "unsaved",
        ]
        others = len(session.maps) - 1
        facts += [f"{others} other map{'' if others == 1 else 's'}"] if others else []
    running = ", ".join(f"[{job.number}] {job.call.command.name}" for job in session.jobs.running)
    facts += [f"running {running}"] if running else []
    facts += [f"{topic} {text}" for topic, text in session.marks.items() if text and topic != SHEEP]
    return " · ".join(facts)


def run_prompt(runner: Runner) -> Status:
    """Read and run lines until the user leaves; return the exit status (always 0 then)."""
    session = runner.session
    plain = not wants_colour(sys.stdout)
    prompt: PromptSession[str] = PromptSession(
        completer=CommandCompleter(session),
        lexer=None if plain else CommandLexer(session),
        history=_history(),
        auto_suggest=AutoSuggestFromHistory(),
        complete_while_typing=False,
        style=_STYLE,
        color_depth=ColorDepth.DEPTH_1_BIT if plain else None,
        bottom_toolbar=None if plain else lambda: toolbar_text(session) or None,
        refresh_interval=0 if plain else 1.0,
    )
    runner.terminal.is_prompt = True
    session.jobs.on_finish = runner.tell_of_job
    for problem in session.registry.problems:
        runner.terminal.warning(problem)
    while True:
        try:
            with patch_stdout(raw=True):
                line = prompt.prompt(lambda: prompt_parts(session))
        except KeyboardInterrupt:
            continue
        except EOFError:
            runner.wants_exit = True
            line = ""
        if line.strip():
            _run_line(runner, line)
        if runner.wants_exit and _may_leave(runner):
            return Status.OK
        runner.wants_exit = False


def _run_line(runner: Runner, line: str) -> None:
    """Run a line; Ctrl-C between commands, where none hears it, must not end the program."""
    try:
        runner.run_text(line)
    except KeyboardInterrupt:
        runner.terminal.error("cancelled")


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
    path = state_folder() / "history"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    except OSError as error:
        sys.stderr.write(f"warning: the history is not kept: {error}\n")
        return InMemoryHistory()
    return FileHistory(str(path))
