"""The migration pages account for every command and every flag of maplab."""

import re
from types import ModuleType
from typing import Any

import pytest

from maplab_py.console.commands.flags import COMMON_FLAGS, Fate, FormerFlag, former_flags
from maplab_py.console.commands.registry import Registry, load_registry
from tests.docs.test_pages import script_module

COMMANDS_IN_MAPLAB = 102
"""Those of maplab 2.2, and two that are in its sources but not compiled."""
FLAGS_IN_MAPLAB = 476
NAMES_IN_TWO_PROGRAMS = 15
"""Names that maplab_node, the server and rovioli each define again."""


class RegistryWithout:
    """A registry that has lost one flag or one command."""

    def __init__(self, registry: Registry, flag: str = "", command: str = "") -> None:
        self._registry = registry
        self._flag = flag
        self.names = [name for name in registry.names if name != command]

    def flags_named(self, name: str) -> Any:
        return [] if name == self._flag else self._registry.flags_named(name)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._registry, name)


@pytest.fixture(scope="module")
def migration() -> ModuleType:
    return script_module("generate_migration_page")


@pytest.fixture(scope="module")
def registry() -> Registry:
    return load_registry()


def test_lists_are_those_of_maplab(migration: ModuleType) -> None:
    names = [name for _, name in migration.flag_names()]
    commands = [names[0] for names, _ in migration.command_table()]
    assert (len(names), len(set(names))) == (
        FLAGS_IN_MAPLAB,
        FLAGS_IN_MAPLAB - NAMES_IN_TWO_PROGRAMS,
    )
    assert len(commands) == len(set(commands)) == COMMANDS_IN_MAPLAB


def test_every_flag_has_one_place_on_the_page(migration: ModuleType, registry: Registry) -> None:
    sections = migration.flags_page(registry).split("\n## ")[1:]
    listed = []
    for section in sections:
        module = section.partition("\n")[0]
        cells = re.findall(r"^- (`[^:]*): (?:same name|renamed; .+|dropped; .+)$", section, re.M)
        listed += [(module, name) for cell in cells for name in re.findall(r"`(\w+)`", cell)]
    assert sorted(listed) == sorted(migration.flag_names())


def test_a_flag_that_the_registry_loses_is_noticed(
    migration: ModuleType, registry: Registry
) -> None:
    with pytest.raises(ValueError, match="flag 'kf_every_nth_vertex' has neither"):
        migration.flags_page(RegistryWithout(registry, flag="kf_every_nth_vertex"))
    with pytest.raises(ValueError, match="no command has the flag --lc_seed"):
        migration.flags_page(RegistryWithout(registry, flag="lc_seed"))


def test_a_command_that_the_registry_loses_is_noticed(
    migration: ModuleType, registry: Registry
) -> None:
    with pytest.raises(ValueError, match="'copy_map' is no command here and has no reason"):
        migration.page(RegistryWithout(registry, command="copy_map"))


def test_a_flag_with_a_namesake_needs_no_reason(
    migration: ModuleType, registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = FormerFlag(Fate.DROPPED, "", "not needed")
    for name, message in (
        ("ba_loss", "the line of 'ba_loss' is wrong"),
        ("ba_fix_velocity", "'ba_fix_velocity' has a namesake here and a line"),
    ):
        table = {**former_flags(), name: line}
        monkeypatch.setattr(migration, "former_flags", lambda table=table: table)
        with pytest.raises(ValueError, match=message):
            migration.flags_page(registry)


def test_reasons_name_commands_and_flags_that_exist(
    migration: ModuleType, registry: Registry
) -> None:
    texts = [flag.note for flag in former_flags().values()]
    texts += [f"`--{flag.new_name}`" for flag in former_flags().values() if flag.new_name]
    texts += [note for _, note in migration.command_table()]
    spans = [
        words
        for text in texts
        for span in re.findall("`([^`]+)`", text)
        for words in [span.split()]
    ]
    flags = [word[2:].partition("=")[0] for words in spans for word in words if word[:2] == "--"]
    commands = [words[0] for words in spans if re.fullmatch(r"[a-z]\w{3,}", words[0])]
    known = {*registry.names, "maplab", "timing"}
    assert len(flags) > 20
    assert len(commands) > 20
    assert [name for name in flags if name not in {*registry.all_flags(), *COMMON_FLAGS}] == []
    assert [name for name in commands if name not in known] == []
