"""Readers on their valid inputs, on mutations of them, and on what fuzzing once found."""

import os
import random
import subprocess
import sys
from pathlib import Path

import pytest

from tests.fuzz import mutations, readers

FINDINGS = Path(__file__).parent / "findings"
_MUTATIONS = 8


@pytest.mark.parametrize("name", readers.READERS)
def test_valid_inputs_are_read_and_mutated_ones_refused(name: str, tmp_path: Path) -> None:
    reader, rng = readers.READERS[name], random.Random(name)
    for folder in ("seeds", "work"):
        (tmp_path / folder).mkdir()
    seeds = reader.seeds(tmp_path / "seeds")
    for seed in seeds:
        if name != "requests":  # without a robot there is nothing to find
            reader.read(tmp_path / "work", seed)
    for _ in range(_MUTATIONS):
        for seed in seeds:
            readers.check(reader, tmp_path / "work", mutations.mutated(rng, seed))


@pytest.mark.parametrize(
    "path", sorted(FINDINGS.glob("*/*")), ids=lambda p: f"{p.parent.name}-{p.name}"
)
def test_findings_stay_mended(path: Path, tmp_path: Path) -> None:
    readers.check(readers.READERS[path.parent.name], tmp_path, path.read_bytes())


@pytest.mark.slow
def test_nothing_is_found_in_5_s(tmp_path: Path) -> None:
    pytest.importorskip("atheris")
    command = [sys.executable, "-m", "tests.fuzz", *readers.READERS, "--seconds=5", "--runs=400"]
    root = Path(__file__).parents[2]
    # the harnesses are modules of the checkout, which tests/conftest.py takes off the path
    environment = {key: text for key, text in os.environ.items() if key != "PYTHONSAFEPATH"}
    done = subprocess.run(
        [*command, f"--corpus={tmp_path}"],
        env=environment,
        capture_output=True,
        text=True,
        cwd=root,
        timeout=900,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert min(len(list((tmp_path / name).iterdir())) for name in readers.READERS) > 1
