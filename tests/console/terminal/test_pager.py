"""Keys that are typed while a command runs belong to the prompt."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from io import TextIOWrapper

import pytest

from maplab_py.console.terminal import output
from tests.support.waiting import wait_until


@pytest.fixture
def keyboard(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Give the end of a pseudo-terminal at which the keys are typed."""
    typing_end, reading_end = os.openpty()
    with os.fdopen(reading_end, "r") as stdin:
        assert isinstance(stdin, TextIOWrapper)
        monkeypatch.setattr(sys, "stdin", stdin)
        yield typing_end
    os.close(typing_end)


@pytest.mark.parametrize("keys", [b"x", b"map_stats\r"])
def test_typed_keys_are_seen_and_left_to_be_read(keyboard: int, keys: bytes) -> None:
    assert not output.keys_are_waiting()
    os.write(keyboard, keys)
    assert wait_until(output.keys_are_waiting)
    if keys.endswith(b"\r"):
        assert sys.stdin.readline() == "map_stats\n"
    else:
        os.write(keyboard, b"\n")
        assert sys.stdin.readline() == "x\n"


def test_nothing_waits_where_there_is_no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    with open(os.devnull) as null:
        monkeypatch.setattr(sys, "stdin", null)
        assert not output.keys_are_waiting()
