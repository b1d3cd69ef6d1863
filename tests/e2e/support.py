"""The real program: as a child process, or in a pseudo-terminal with a screen."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import pexpect
import pyte

PROGRAM = [sys.executable, "-m", "maplab_py"]
ROWS, COLUMNS = 40, 120
CURSOR_QUESTION = "\x1b[6n"


def environment(home: Path, **extra: str) -> dict[str, str]:
    """Return the environment of a user whose files lie under `home`."""
    # readline exports the size of pytest's terminal to the processes of xdist
    others = ("NO_COLOR", "MAPLAB_PLUGINS", "COLUMNS", "LINES")
    kept = {k: v for k, v in os.environ.items() if k not in others}
    cache = os.environ.get("XDG_CACHE_HOME", str(Path.home() / ".cache"))
    return {
        **kept,
        "XDG_CACHE_HOME": cache,  # kernels need not be compiled anew for every user
        "HOME": str(home),
        "XDG_STATE_HOME": str(home / "state"),
        "XDG_CONFIG_HOME": str(home / "config"),
        "TERM": "xterm-256color",
        "MAPLAB_PAGER": "cat",
        **extra,
    }


def run_program(
    home: Path,
    *arguments: str,
    text: str = "",
    extra: Mapping[str, str] | None = None,
    seconds: float = 120,
) -> subprocess.CompletedProcess[str]:
    """Run the program to its end with `text` on its standard input."""
    return subprocess.run(
        [*PROGRAM, *arguments],
        input=text,
        capture_output=True,
        text=True,
        timeout=seconds,
        cwd=home,
        env=environment(home, **(extra or {})),
        check=False,
    )


class Console:
    """The program in a pseudo-terminal, with what a person would see of it."""

    def __init__(
        self, home: Path, *arguments: str, ignores_hang_ups: bool = False, **extra: str
    ) -> None:
        self.child = pexpect.spawn(
            PROGRAM[0],
            [*PROGRAM[1:], *arguments],
            env=environment(home, **extra),
            cwd=str(home),
            dimensions=(ROWS, COLUMNS),
            encoding="utf-8",
            timeout=30,
            ignore_sighup=ignores_hang_ups,
        )
        self.screen = pyte.Screen(COLUMNS, ROWS)
        self._stream = pyte.Stream(self.screen)

    @property
    def text(self) -> str:
        """The screen's lines."""
        return "\n".join(line.rstrip() for line in self.screen.display).rstrip()

    @property
    def unwrapped(self) -> str:
        """The screen's text with the lines that the terminal wrapped joined again."""
        return "".join(self.screen.display)

    @property
    def last_line(self) -> str:
        """The lowest line that is not empty, the toolbar apart."""
        lines = [line for line in self.text.splitlines() if line.strip()]
        if len(lines) > 1 and " · " in lines[-1]:
            lines.pop()
        return lines[-1] if lines else ""

    def close(self) -> None:
        """End the program, however long a busy machine takes for it."""
        if self.child.isalive():
            self.child.kill(signal.SIGKILL)
            self.child.wait()
        self.child.close()

    def type(self, text: str) -> None:
        """Type at a person's pace."""
        for character in text:
            self.child.send(character)
            self._read(0.01)

    def enter(self, line: str) -> None:
        """Type a line and press Enter."""
        self.type(line + "\r")

    def wait_for(self, condition: Callable[[str], bool], seconds: float = 60.0) -> str:
        """Wait until the screen fulfils a condition, and return its text."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._read(0.05)
            if condition(self.text):
                return self.text
        raise AssertionError(f"the screen never came; it shows:\n{self.text}")

    def wait_for_text(self, text: str) -> str:
        """Wait until a text is on the screen."""
        return self.wait_for(lambda screen: text in screen)

    def wait_for_prompt(self, prompt: str = "maplab <>:/$") -> str:
        """Wait until the last line is an empty prompt."""
        return self.wait_for(lambda _: self.last_line == prompt)

    def wait_until_still(self, still_s: float = 0.5) -> str:
        """Wait until nothing is drawn any more (the toolbar comes after the prompt); return it."""
        text, since = self.text, time.monotonic()
        end = since + 20.0
        while time.monotonic() < end:
            self._read(0.05)
            if self.text != text:
                text, since = self.text, time.monotonic()
            elif time.monotonic() > since + still_s:
                return text
        raise AssertionError(f"the screen never rests; it shows:\n{self.text}")

    def processor_seconds(self) -> float:
        """Return the processor time that the program has used so far."""
        fields = Path(f"/proc/{self.child.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def children(self) -> list[str]:
        """Return the command lines of the program's children."""
        numbers = " ".join(
            path.read_text() for path in Path(f"/proc/{self.child.pid}/task").glob("*/children")
        )
        commands = (Path(f"/proc/{number}/cmdline") for number in numbers.split())
        return [path.read_text().replace("\0", " ") for path in commands if path.exists()]

    def status(self) -> int:
        """Wait for the end and return the exit status."""
        self.child.expect(pexpect.EOF)
        return int(self.child.wait())

    def _read(self, seconds: float) -> None:
        try:
            text = self.child.read_nonblocking(65536, timeout=seconds)
            for part in re.split(r"(\x1b\[6n)", text):
                self._stream.feed(part)
                if part == CURSOR_QUESTION:
                    cursor = self.screen.cursor
                    self.child.send(f"\x1b[{cursor.y + 1};{cursor.x + 1}R")
        except pexpect.TIMEOUT:
            return
        except pexpect.EOF:
            time.sleep(seconds)
