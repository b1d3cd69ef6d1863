"""Typed text split into commands, and plugins that are found, broken, clashing or restricted."""

import ast
import functools
import itertools
import shlex
import sys
import threading
import time
import types
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.console.commands import flag_index, schema
from maplab_py.console.commands import registry as registry_module
from maplab_py.console.commands.command import describe
from maplab_py.console.commands.flag_index import Index, kept_index
from maplab_py.console.commands.lines import scan, split_commands
from maplab_py.console.commands.registry import (
    BUILT_IN,
    ENTRY_POINT_GROUP,
    PLUGINS_VARIABLE,
    Plugin,
    Registry,
    load_registry,
)
from maplab_py.console.session.settings import Layer, Settings
from maplab_py.errors import FlagError, UserError
from maplab_py.plugin import CommandContext, Message, command
from tests.support.own_process import in_own_process


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


SOURCE = '''
from maplab_py.plugin import CommandContext, Message, command
from tests.support.own_process import in_own_process

@command("{name}", "{alias}", needs_map=False)
def run(context: CommandContext) -> Message:
    """Say {name}."""
    return Message("{name}")
'''


def entry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, source: str) -> EntryPoint:
    module = f"maplab_test_{name}"
    (tmp_path / f"{module}.py").write_text(source)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, module, raising=False)
    return EntryPoint(name, module, ENTRY_POINT_GROUP)


def test_commands_come_from_entry_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one = entry(tmp_path, monkeypatch, "one", SOURCE.format(name="first", alias="f"))
    registry = load_registry([one])
    assert registry.names == ["f", "first"]
    assert registry.owner(registry.find("f")) == "one"
    assert registry.problems == []


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("import no_such_library", "No module named 'no_such_library'"),
        ("raise SystemExit(3)", "SystemExit"),
        ("def broken(:", "SyntaxError"),
        (SOURCE.format(name="x", alias="y").replace('"""Say x."""', ""), "no docstring"),
    ],
)
def test_a_broken_plugin_is_listed_and_harms_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str, reason: str
) -> None:
    good = entry(tmp_path, monkeypatch, "good", SOURCE.format(name="first", alias="f"))
    bad = entry(tmp_path, monkeypatch, "bad", source)
    registry = load_registry([good, bad])
    assert registry.names == ["f", "first"]
    assert "bad" in registry.problems[0]
    assert reason in registry.problems[0]
    with pytest.raises(UserError, match="plugins not available: bad"):
        registry.find("zzz")


def test_a_duplicate_command_stays_with_the_first_and_names_both(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = entry(tmp_path, monkeypatch, "aaa", SOURCE.format(name="same", alias="s"))
    second = entry(tmp_path, monkeypatch, "bbb", SOURCE.format(name="same", alias="t"))
    third = entry(tmp_path, monkeypatch, "ccc", SOURCE.format(name="other", alias="s"))
    registry = load_registry([third, second, first])
    assert registry.owner(registry.find("same")) == "aaa"
    assert registry.find("s").name == "same"
    assert registry.problems == [
        "command 'same' of plugin bbb is taken by plugin aaa, which keeps it",
        "command 's' of plugin ccc is taken by plugin aaa, which keeps it",
    ]


def test_an_index_of_flags_is_kept_unless_a_plugin_is_broken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "maplab_test_package"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / ".#locked.py").symlink_to("nowhere")  # as editors lock a file
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(flag_index, "_PACKAGES", (package.name,))
    monkeypatch.setenv("MAPLAB_CACHE_DIR", str(tmp_path / "cache"))
    index, made = {"rate": ["a"]}, list[bool]()

    def make(*, is_whole: bool = True) -> tuple[Index, bool]:
        made.append(is_whole)
        return index, is_whole

    for is_whole in (False, True, True):
        assert kept_index(["a"], functools.partial(make, is_whole=is_whole)) == index
    assert made == [False, True]
    (kept,) = (tmp_path / "cache").rglob("*.json")
    for number, damaged in enumerate(("{", "[]", '{"rate": null}'), start=3):
        kept.write_text(damaged)
        assert kept_index(["a"], make) == index
        assert len(made) == number
    (package / "__init__.py").write_text("1")
    kept_index(["a"], make)
    monkeypatch.setenv("MAPLAB_CACHE_DIR", str(package / "__init__.py"))  # no folder
    assert kept_index(["a"], make) == index
    assert len(made) == 7


def test_a_flag_of_a_plugin_that_broke_since_is_an_error_of_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(registry_module, "kept_index", lambda *_: {"rate": ["bad"]})
    bad = EntryPoint("bad", f"{BUILT_IN}no_such_module", ENTRY_POINT_GROUP)
    with pytest.raises(FlagError, match="--rate: the plugin of its commands is not available"):
        Settings(Registry([bad])).assign(["--rate=1"], Layer.SET, "set")


def test_the_environment_restricts_what_loads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entries = [
        entry(tmp_path, monkeypatch, name, SOURCE.format(name=name, alias=name[0]))
        for name in ("console", "apple", "berry")
    ]
    monkeypatch.setenv(PLUGINS_VARIABLE, "berry")
    assert [plugin.name for plugin in load_registry(entries).plugins] == ["console", "berry"]
    monkeypatch.setenv(PLUGINS_VARIABLE, "berry;cherry")
    with pytest.raises(UserError, match="not installed: cherry"):
        load_registry(entries)


def test_imported_commands_stay_with_the_module_that_defines_them() -> None:
    @command("elsewhere")
    def elsewhere(context: CommandContext) -> Message:
        """Belong to another module."""
        return Message("")

    module = types.ModuleType("somebody")
    module.elsewhere = elsewhere  # type: ignore[attr-defined]
    registry = Registry()
    registry.add_module(module, Plugin("somebody"))
    assert registry.commands == []


def test_dashes_in_command_names_equal_underscores() -> None:
    def run(context: CommandContext) -> None:
        """Do it."""

    registry = Registry()
    registry.add(describe(run, "map_stats", ("ms",)), Plugin("p"))
    assert registry.find("map-stats").name == "map_stats"


def test_the_installed_plugins_load() -> None:
    registry = load_registry()
    names = {plugin.name for plugin in registry.plugins if not plugin.error}
    assert {"console", "vi_map_basic", "missions"} <= names


def _plugins_imported_for_names() -> list[tuple[str, str, list[str], bool]]:
    """Look for the names of each built-in plugin: its name, its error, what was imported, all found."""
    loaded: list[str] = []
    load = EntryPoint.load
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(EntryPoint, "load", lambda self: loaded.append(self.name) or load(self))
        entries = [e for e in entry_points(group=ENTRY_POINT_GROUP) if e.value.startswith(BUILT_IN)]
        rows = []
        for plugin in load_registry(entries).plugins:
            registry = load_registry(entries)
            loaded.clear()
            found = [
                registry.find(name) == c and registry.find(name).name == c.name
                for c in plugin.commands
                for name in c.names
            ]
            rows.append((plugin.name, plugin.error, list(loaded), bool(found) and all(found)))
    return rows


def test_a_command_is_found_without_importing_other_plugins() -> None:
    """Every name and alias of the built-in plugins is declared where it is found without an import."""
    rows = in_own_process(_plugins_imported_for_names)
    assert len(rows) > 10
    assert rows == [(name, "", [name], True) for name, *_ in rows]


def test_a_plugin_of_others_is_imported_for_a_name_that_no_built_in_one_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = entry(tmp_path, monkeypatch, "other", SOURCE.format(name="lc", alias="mine"))
    registry = load_registry([*entry_points(group=ENTRY_POINT_GROUP), other])
    assert registry.owner(registry.find("lc")) == "loopclosure"
    with pytest.raises(UserError, match="did you mean lc"):
        registry.find("lcc")
    assert registry.problems == [
        "command 'lc' of plugin other is taken by plugin loopclosure, which keeps it"
    ]


def test_schemas_can_be_made_by_two_threads_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """An abandoned `schema` may still run: two syntax trees at once are a SystemError in Python 3.11."""
    registry = load_registry()
    inside, overlaps = threading.Semaphore(1), []
    parse = ast.parse

    def watched(*arguments: Any, **keywords: Any) -> ast.AST:
        if not inside.acquire(blocking=False):
            overlaps.append(1)
            return parse(*arguments, **keywords)
        try:
            time.sleep(1e-3)
            return parse(*arguments, **keywords)
        finally:
            inside.release()

    monkeypatch.setattr(ast, "parse", watched)
    schema._imported_names.cache_clear()
    threads = [
        threading.Thread(target=schema.line_schema, args=(registry.commands,)) for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert overlaps == []
