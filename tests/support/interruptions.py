"""Ctrl-C at several moments of a command, in the real console in a pseudo-terminal."""

import contextlib
import dataclasses
import re
import shutil
import signal
import time
from pathlib import Path

import pexpect

from maplab_py.console.commands.registry import load_registry
from maplab_py.storage.native import load_map
from tests.e2e.support import environment
from tests.registry.workspace import MERGED, lines_before, write_workspace
from tests.simulation.small import simulated
from tests.support.data import REPOSITORY
from tests.support.programs import module_program

CTRL_C = "\x03"
SHARES = (0.3, 0.5, 0.7, 0.9)
"""Of a command's run time, when Ctrl-C is pressed."""
OTHER_LINES = {
    "self_calibrate": (
        "load maps/v1_01; elq; set --sc_states=intrinsics,extrinsics_rotation",
        "self_calibrate --database=device.segments",
    ),
}
"""Lines before and example of commands whose usual ones do not take two devices."""
_PROMPT = re.compile(r"maplab <[^>]*>\*?:/\$ (\^C)?$")
"""The prompt; a Ctrl-C that comes in the moment in which it is drawn is echoed behind it."""


@dataclasses.dataclass(frozen=True)
class Press:
    """What one Ctrl-C did.

    Attributes:
        after_s: When it was pressed.
        prompt_s: Seconds until the prompt was back.
        outcome: "cancelled", "done" (the command had done its work before) or "failed".
        harm: What differs from before although the command was cancelled; empty = nothing.
    """

    command: str
    after_s: float
    prompt_s: float
    outcome: str
    harm: str


class Workspace:
    """The folder in which the examples of all commands can be typed, with a large first map."""

    def __init__(self, folder: Path, first: Path) -> None:
        """Write it.

        Args:
            folder: Where to.
            first: Folder of the map that takes the place of maps/v1_01.
        """
        from tests.registry.workspace import ROUND

        self._original = folder / "original"
        self._original.mkdir(parents=True)
        data = simulated(ROUND)
        (self._original / "simulated").mkdir()
        data.truth.save(self._original / "simulated" / "truth.npz")
        write_workspace(self._original, load_map(first)[0], data.maps[1])
        self.home = folder / "home"
        self.folder = folder / "here"
        self.home.mkdir()
        self.folder.mkdir()
        self.put_back()

    def put_back(self) -> None:
        """Make the folder what it was at first."""
        for path in self.folder.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        shutil.copytree(self._original, self.folder, dirs_exist_ok=True)

    def listing(self) -> dict[str, tuple[int, int]]:
        """Return size and time of change of every file, and the names of folders."""
        found = {}
        for path in self.folder.rglob("*"):
            status = path.lstat()
            is_file = not path.is_dir()
            found[str(path.relative_to(self.folder))] = (
                (status.st_size, status.st_mtime_ns) if is_file else (-1, -1)
            )
        return found


def _installed_plugin(workspace: Workspace) -> Path:
    """Make a folder that lets Python find the plugin as if it were installed; return it."""
    folder = workspace.home / "site"
    about = folder / "state_plugin-1.dist-info"
    about.mkdir(parents=True, exist_ok=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: state-plugin\nVersion: 1\n")
    line = "[maplab_py.plugins]\nstate = tests.support.state_plugin\n"
    (about / "entry_points.txt").write_text(line)
    return folder


class Interrupter:
    """A console that runs commands and is interrupted."""

    def __init__(self, workspace: Workspace) -> None:
        """Start the console."""
        self._workspace = workspace
        plugin = str(_installed_plugin(workspace))
        program = module_program("maplab_py", str(REPOSITORY), plugin)
        self._child = pexpect.spawn(
            program[0],
            program[1:],
            env=environment(workspace.home, TERM="dumb"),
            cwd=str(workspace.folder),
            dimensions=(50, 4000),
            encoding="utf-8",
            timeout=120,
        )
        self._registry = load_registry()
        self._names: dict[str, str] = {}
        self._marks = 0
        self.unread = ""
        self._read_prompt()

    def close(self) -> None:
        """End the console, however long a busy machine takes for it."""
        if self._child.isalive():
            self._child.kill(signal.SIGKILL)
            self._child.wait()
        self._child.close()

    def run(self, line: str, seconds: float = 120.0) -> str:
        """Run a line to its end and return what was printed meanwhile."""
        self._child.sendline(line)
        return self._read_prompt(seconds) + self._read_rest()

    def _answer(self, line: str, answer: str) -> str:
        """Run a line until its answer has come; Ctrl-C that was pressed before may have dropped it.

        Args:
            line: The line; running it again changes nothing.
            answer: Pattern of the answer, with one group.
        """
        printed = []
        for _ in range(3):
            printed.append(self.run(line))
            if found := re.search(answer, printed[-1]):
                return found.group(1)
        raise AssertionError(printed)

    def interrupt(
        self, name: str, *, at_most_s: float, shares: tuple[float, ...] = SHARES
    ) -> list[Press]:
        """Interrupt the example of a command at several moments.

        Args:
            name: The command.
            at_most_s: Longer commands are taken for as long as this.
            shares: Of its run time, when Ctrl-C is pressed.
        """
        example = OTHER_LINES.get(name, ("", self._registry.find(name).example))[1]
        self._prepare(name)
        presses = [self._press(name, example, 0.15)]  # also while it imports what it needs
        time_s = self._time_of(example, at_most_s)
        self._prepare(name)
        presses += [self._press(name, example, share * time_s) for share in shares]
        return presses

    def _prepare(self, name: str) -> None:
        """Bring about the state in which the example can be typed."""
        self._workspace.put_back()
        lines = OTHER_LINES[name][0] if name in OTHER_LINES else lines_before(name)
        further = lines.removeprefix(MERGED)  # what may write files or start something
        if lines not in self._names or re.search("!|visualize|_", further):
            self.run("clear_storage --yes")
            for line in lines.split("; "):
                if line.strip():
                    self.run(line)
            self._names[lines] = f"state{len(self._names)}"
            self.run(f"remember_state {self._names[lines]}")
        self._put_back(self._names[lines])

    def _put_back(self, state: str) -> None:
        self._answer(f"put_back_state {state}", f"put back ({state})\\b")

    def _time_of(self, example: str, at_most_s: float) -> float:
        start = time.monotonic()
        self._child.sendline(example)
        try:
            self._read_prompt(at_most_s)
        except pexpect.TIMEOUT:
            self._child.send(CTRL_C)
            self._read_prompt()
        time_s = time.monotonic() - start
        self._read_rest()
        return time_s

    def _press(self, name: str, example: str, after_s: float) -> Press:
        files, maps = self._workspace.listing(), self._digest()
        self._child.sendline(example)
        try:
            text, prompt_s = self._read_prompt(after_s), 0.0
        except pexpect.TIMEOUT:
            start = time.monotonic()
            self._child.send(CTRL_C)
            text = self._read_prompt(text=self.unread)
            prompt_s = time.monotonic() - start
        outcome = "cancelled" if "cancelled; the maps are as before" in text else "done"
        error = re.search(r"error: .*", text)
        if outcome == "done" and error and "finished before Ctrl-C" not in text:
            outcome = f"failed ({error.group()})"
        self._read_rest()
        harm = ""
        if outcome != "done":
            changed = set(files.items()) ^ set(self._workspace.listing().items())
            harm = ", ".join(sorted({path for path, _ in changed})[:3])
            harm += "" if self._digest() == maps else " maps differ"
        if outcome == "done" or harm:
            self._prepare(name)
        return Press(name, after_s, prompt_s, outcome, harm.strip())

    def _digest(self) -> str:
        return self._answer("digest_state", r"digest (\w+) end")

    def _read_prompt(self, seconds: float = 120.0, text: str = "", wanted: str = "") -> str:
        """Read on, behind a text, until the console has printed what is expected and waits."""
        end = time.monotonic() + seconds
        while True:
            try:
                text += self._child.read_nonblocking(65536, timeout=0.01)
            except pexpect.TIMEOUT:
                if _PROMPT.search(text) and wanted in text:
                    return text
                if time.monotonic() > end:
                    self.unread = text
                    raise

    def _read_rest(self) -> str:
        """Read what still comes, such as a second prompt.

        A line that is typed while the console cleans up may be dropped, as Ctrl-C drops a line.
        """
        text = ""
        for _ in range(60):
            self._marks += 1
            self._child.sendline(f"mark_state {self._marks}")
            with contextlib.suppress(pexpect.TIMEOUT):
                return self._read_prompt(2.0, text, f"mark {self._marks} end")
            text = self.unread
        raise AssertionError(f"the console answers no more: {text}")
