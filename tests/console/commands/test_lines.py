"""Splitting typed text into commands and words."""

from __future__ import annotations

import itertools
import shlex

import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.console.commands.lines import scan, split_commands
from maplab_py.errors import FlagError


@pytest.mark.parametrize(
    ("text", "commands"),
    [
        ("", []),
        (" ; \n ;", []),
        ("load a; save", [["load", "a"], ["save"]]),
        ("load a;save\noptvi", [["load", "a"], ["save"], ["optvi"]]),
        ("a 'b; c' \"d # e\"", [["a", "b; c", "d # e"]]),
        ("a b#c # comment\nd", [["a", "b#c"], ["d"]]),
        ("# only\n", []),
        ("a \\\n b", [["a", "b"]]),
        ("a b\\ c", [["a", "b c"]]),
        ("a --f='x y'z", [["a", "--f=x yz"]]),
        ("a ''", [["a", ""]]),
        (r'a "b\"c\d"', [["a", r'b"c\d']]),
    ],
)
def test_splits_as_a_shell_does(text: str, commands: list[list[str]]) -> None:
    assert split_commands(text) == commands


@pytest.mark.parametrize("text", ["a 'b", 'a "b', "a b\\"])
def test_open_quote_is_an_error_of_one_line(text: str) -> None:
    with pytest.raises(FlagError, match="unclosed") as error:
        split_commands(text)
    assert "\n" not in str(error.value)


@given(st.lists(st.text(min_size=1).filter(lambda word: "\0" not in word), min_size=1))
def test_quoted_words_come_back(words: list[str]) -> None:
    assert split_commands(" ".join(shlex.quote(word) for word in words)) == [words]


@given(st.text())
def test_scan_covers_every_word_once(text: str) -> None:
    words = [word for command in scan(text) for word in command]
    assert all(a.end <= b.start for a, b in itertools.pairwise(words))
    assert all(word.start < word.end <= len(text) for word in words)
