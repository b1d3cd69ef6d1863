"""Golden screens: what every command shows at 80, 100 and 160 columns.

`python -m tests.console.screens [COMMAND ...]` writes them again after a wanted change.
"""

from pathlib import Path

import pytest

from maplab_py.console.commands.registry import load_registry
from tests.console.screens.collection import (
    GOLDEN,
    NOT_RECORDED,
    Collection,
    parameters,
    recorded_commands,
)

REGISTRY = load_registry()


@pytest.fixture(scope="module")
def collection(tmp_path_factory: pytest.TempPathFactory) -> Collection:
    return Collection(tmp_path_factory.mktemp("screens"))


@pytest.mark.parametrize("name", parameters(REGISTRY))
def test_screens(
    collection: Collection, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    text = (GOLDEN / f"{name}.txt").read_text(encoding="utf-8")
    assert collection.screens(name) == text, "see the first lines of this file"


def test_every_command_has_screens_or_a_reason() -> None:
    assert {path.stem for path in GOLDEN.glob("*.txt")} == set(recorded_commands(REGISTRY))
    assert set(NOT_RECORDED) <= set(REGISTRY.names)
