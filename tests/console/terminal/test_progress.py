"""The bar of a command on a terminal."""

from __future__ import annotations

import io

import pyte
import pytest

from maplab_py.console.terminal.progress import SECONDS_BEFORE_BAR, TerminalProgress


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def lines(width: int, what: str, total: float, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return what a terminal of some width shows of a bar at three tenths."""
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    stream = _Terminal()
    progress = TerminalProgress(stream)
    progress._start -= 2 * SECONDS_BEFORE_BAR
    progress.step(0.3 * total, total, what)
    assert progress._bar is not None
    progress._bar.refresh()  # the next of ten a second
    screen = pyte.Screen(width, 6)
    pyte.Stream(screen).feed(stream.getvalue().replace("\n", "\r\n"))
    shown = [line.rstrip() for line in screen.display if line.strip()]
    progress.close()
    return shown


@pytest.mark.parametrize("width", [60, 80, 120])
@pytest.mark.parametrize("total", [0.0, 20.0])
def test_a_long_step_is_cut_and_the_time_stays(
    width: int, total: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    what = "12.4 s  287 tracks  164 landmarks  21 ms (read 2, tracking 11, window 7, map 1)"
    (line,) = lines(width, what, total, monkeypatch)
    assert line.startswith(what[: width // 3])
    assert line.endswith("0:00:00 elapsed")
    assert ("…" in line) == (width < 120)


def test_a_short_step_is_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    (line,) = lines(80, "iteration 3 of at most 20", 20.0, monkeypatch)
    assert line.startswith("iteration 3 of at most 20 ━")
    assert "30%" in line
