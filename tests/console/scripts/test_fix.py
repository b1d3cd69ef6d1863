"""Refusals that a command mends: `fix` at the prompt, `--auto_fix` in scripts."""

from __future__ import annotations

import ast
import dataclasses
from collections.abc import Iterator
from pathlib import Path

import maplab_plugins
import numpy as np
import pytest

import maplab_py
from maplab_py.console.commands.registry import load_registry
from maplab_py.console.scripts.runner import Runner
from maplab_py.console.session.session import Session
from maplab_py.console.session.status import Status
from maplab_py.console.terminal.output import ConsoleTerminal
from maplab_py.vimap import LandmarkQuality
from tests.plugins.test_loopclosure import TWICE, session_of

CLOSE = "lc --lc_max_merge_gap_m=0.2"


def runner_of(session: Session) -> Runner:
    return Runner(session, ConsoleTerminal())


@pytest.fixture
def drifted() -> Runner:
    """A session walked twice, whose closures correct more than landmarks may be moved."""
    return runner_of(session_of(TWICE))


def test_fix_runs_the_remedy_and_the_refused_command(
    drifted: Runner, capsys: pytest.CaptureFixture[str]
) -> None:
    assert drifted.run_text(CLOSE) == Status.FAILED
    assert "run relax first" in capsys.readouterr().err
    assert drifted.run_text("map_stats; fix") == Status.OK
    assert int(drifted.session.run("lc").landmarks_merged) == 0  # all is merged
    assert drifted.run_text("fix") == Status.USER_ERROR
    assert "no command was refused" in capsys.readouterr().err


def test_scripts_mend_themselves_only_when_asked(drifted: Runner) -> None:
    assert drifted.run_script(f"{CLOSE}; map_stats") == Status.FAILED
    drifted.run_text("undo")
    drifted.session.set_flags(["--auto_fix"])
    assert drifted.run_script(f"{CLOSE}; map_stats") == Status.OK


def test_bad_landmarks_are_judged_again() -> None:
    session = session_of(TWICE)
    vi_map = session.vi_map
    bad = np.full(len(vi_map.landmarks), LandmarkQuality.BAD, dtype=vi_map.landmarks.quality.dtype)
    landmarks = dataclasses.replace(vi_map.landmarks, quality=bad)
    judged = dataclasses.replace(vi_map, landmarks=landmarks)
    session.maps.update(session.maps.selected.with_value(judged, "elq"))
    session.set_flags(["--auto_fix"])
    assert runner_of(session).run_text("landmark_sparsify --num_landmarks_to_keep=50") == Status.OK
    assert (session.vi_map.landmarks.quality == LandmarkQuality.GOOD).sum() == 50


def test_a_refusal_without_a_remedy_is_not_repeated(
    drifted: Runner, capsys: pytest.CaptureFixture[str]
) -> None:
    drifted.session.set_flags(["--auto_fix"])
    assert drifted.run_text("landmark_sparsify") == Status.USER_ERROR
    assert len(capsys.readouterr().err.splitlines()) == 1


def remedies() -> Iterator[str]:
    """Yield the remedies of all errors in the sources."""
    for package in (maplab_py, maplab_plugins):
        for path in Path(str(package.__file__)).parent.rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.keyword) and node.arg == "remedy":
                    value = node.value
                    if isinstance(value, ast.Constant) and isinstance(value.value, str):
                        yield value.value


def test_remedies_of_errors_are_commands_that_need_no_more() -> None:
    session = Session(load_registry())
    lines = {line for line in remedies() if line in session.registry.names}
    assert {"retriangulate_landmarks", "loopclosure_all_missions"} <= lines
    for line in lines:
        assert session.parse([line]).command.name == line
