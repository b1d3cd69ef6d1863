"""A save of new resources that is killed leaves the old or the new map, with all its files."""

import json
import os
import subprocess
from pathlib import Path

import pytest

from tests.support import data, programs

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs fork and SIGKILL")


def outcomes(folder: Path, *words: str) -> list[str]:
    done = subprocess.run(
        [*programs.module_of_tests("tests.storage.kills"), str(folder), *words],
        cwd=data.REPOSITORY,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    result: list[str] = json.loads(done.stdout)
    return result


def test_a_few_kills(tmp_path: Path) -> None:
    found = outcomes(tmp_path, "60", "6")
    assert len(found) == 7
    assert found[0] == "new"
    assert set(found) == {"old", "new"}


@pytest.mark.slow
@pytest.mark.parametrize("place", [(), ("external",)])
def test_kills_of_saves_with_many_resources(tmp_path: Path, place: tuple[str, ...]) -> None:
    found = outcomes(tmp_path, "300", "20", *place)
    assert len(found) == 21
    assert set(found) == {"old", "new"}
    assert found.count("old") > 4
