"""Questions with several answers."""

from __future__ import annotations

import io

import pytest

from maplab_py.console.terminal.output import ConsoleTerminal
from maplab_py.console.terminal.protocol import SilentTerminal
from maplab_py.errors import Cancelled, UserError

ANSWERS = ("yes", "no", "quit")


def choose(typed: str, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr("sys.stdin", io.StringIO(typed))
    return ConsoleTerminal().choose("remove?", ANSWERS)


@pytest.mark.parametrize(
    ("typed", "answer"), [("y\n", "yes"), ("No\n", "no"), (" quit \n", "quit"), ("q", "quit")]
)
def test_words_and_first_letters_are_answers(
    typed: str, answer: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert choose(typed, monkeypatch) == answer


def test_the_question_is_repeated_until_there_is_an_answer(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert choose("\nmaybe\nye\nn\n", monkeypatch) == "no"
    assert capsys.readouterr().err == "remove? [y/n/q] " * 4


def test_the_end_of_the_input_cancels(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(Cancelled, match="the input has ended"):
        choose("maybe\n", monkeypatch)
    with pytest.raises(UserError, match="nobody is there to answer"):
        SilentTerminal().choose("remove?", ANSWERS)
