"""Scripts that are killed, terminated or fail at any step: what they made until then can be loaded."""

import signal
from pathlib import Path

import pytest

from maplab_py.console.session.session import Session
from maplab_py.errors import UserError
from maplab_py.storage.native import save_map
from tests.console.sample_plugin import map_of
from tests.e2e.support import run_program

STEPS = (
    "load m",
    "remove_mission --map_mission=1 --yes",
    "rename_map n",
    "save --map_folder=n",
)
MADE: tuple[dict[str, int], ...] = ({}, {"m": 1}, {"n": 1}, {})
"""Unsaved maps with their numbers of missions after each of the steps."""
KILL = "!kill -KILL $PPID"
TERMINATE = "!kill -TERM $PPID && sleep 1"
FAIL = "restore nothing"


@pytest.mark.parametrize(
    ("count", "end", "status"),
    [
        *((count, KILL, -signal.SIGKILL) for count in range(1, len(STEPS) + 1)),
        (2, TERMINATE, 130),
        (2, FAIL, 2),
    ],
)
def test_what_a_script_has_made_can_be_loaded(
    count: int, end: str, status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_map(map_of(2), tmp_path / "m")
    script = "\n".join((*STEPS[:count], end))
    (tmp_path / "s.maplab").write_text(f"set checkpoint_seconds=0\n{script}\n")
    done = run_program(tmp_path, "run", "s.maplab")
    assert done.returncode == status, done.stderr
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    session = Session()
    if not MADE[count - 1]:
        with pytest.raises(UserError, match="no script has left unsaved maps"):
            session.run("recover")
        return
    session.run("recover")
    assert {entry.key: len(entry.vi_map.missions) for entry in session.maps} == MADE[count - 1]


def test_a_background_job_can_be_terminated(tmp_path: Path) -> None:
    """Shells start such jobs with Ctrl-C ignored."""
    (tmp_path / "s.maplab").write_text(TERMINATE)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        assert run_program(tmp_path, "run", "s.maplab").returncode == 130
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_script_that_ends_well_leaves_no_copies(tmp_path: Path) -> None:
    save_map(map_of(1), tmp_path / "m")
    text = "set checkpoint_seconds=0; load m; remove_mission --map_mission=1 --yes; save n"
    assert run_program(tmp_path, "-c", text).returncode == 0
    assert not any((tmp_path / "state" / "maplab" / "rescued").iterdir())
