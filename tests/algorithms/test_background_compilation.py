"""Kernels are compiled by processes of low priority, and nobody waits for one that is gone."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

import pytest

from maplab_py.algorithms import background_compilation
from maplab_py.algorithms.background_compilation import LOWEST_PRIORITY, BackgroundCompilation
from maplab_py.algorithms.rig_warmup import REPROJECTION, RigKernels
from maplab_py.errors import Cancelled
from maplab_py.progress import SILENT, SilentProgress
from maplab_py.sensors import Distortion, Projection
from tests.support.waiting import wait_until

RIG = RigKernels(((Projection.PINHOLE, Distortion.RADTAN),), moving=False)
QUICK = ("preintegration", "block Cholesky")
"""Jobs that the tests' warmup has stored, so that they take a moment."""


class Steps(SilentProgress):
    """Notes what a bar would show."""

    def __init__(self) -> None:
        self.steps: list[tuple[float, float, str]] = []

    def step(self, done: float, total: float, what: str = "") -> None:
        self.steps.append((done, total, what))


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 2)


@contextlib.contextmanager
def compiling(*jobs: str) -> Iterator[BackgroundCompilation]:
    with contextlib.closing(BackgroundCompilation(RIG, jobs)) as compilation:
        yield compilation


def test_the_process_has_the_lowest_priority_and_ends_when_it_is_done() -> None:
    with compiling(*QUICK) as compilation:
        number, _ = compilation.process_ids
        assert wait_until(lambda: os.getpriority(os.PRIO_PROCESS, number) == LOWEST_PRIORITY)
        compilation.wait(SILENT)
        compilation.wait(SILENT)
        assert compilation.is_finished


def test_waiting_hurries_and_shows_a_bar() -> None:
    steps = Steps()
    with compiling(*QUICK) as compilation:
        compilation.wait(steps)
        assert compilation.is_finished
    assert steps.steps
    assert steps.steps[0][1:] == (2, "compile kernels (once per machine)")


def test_waiting_can_be_cancelled() -> None:
    class Impatient(SilentProgress):
        def step(self, done: float, total: float, what: str = "") -> None:
            raise Cancelled("enough")

    with compiling(*QUICK) as compilation:
        with pytest.raises(Cancelled):
            compilation.wait(Impatient())
        assert len(compilation.process_ids) <= 2  # the hurried one is gone
    assert not compilation.process_ids


def test_a_job_that_fails_holds_nobody_up() -> None:
    with compiling("no such job") as compilation:
        compilation.wait(SILENT)
        assert compilation.is_finished


def test_a_process_ends_with_whoever_started_it() -> None:
    with compiling(QUICK[0]) as compilation:
        (process,) = compilation._processes
        assert process.stdin is not None
        process.stdin.close()
        assert wait_until(lambda: process.poll() is not None)


def test_a_single_core_is_left_to_the_user(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    with compiling(*QUICK) as compilation:
        assert not compilation.process_ids
        compilation.wait(SILENT)


def test_no_process_can_be_started(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError("no more processes")

    monkeypatch.setattr(background_compilation.subprocess, "Popen", refuse)
    with compiling(*QUICK) as compilation:
        assert not compilation.process_ids
        compilation.wait(SILENT)


def test_a_rig_survives_the_way_to_another_process() -> None:
    two = RigKernels(
        ((Projection.PINHOLE, Distortion.FOV), (Projection.PINHOLE, Distortion.NONE)), True
    )
    for rig in (RIG, two):
        assert RigKernels.from_words(rig.words) == rig


def test_what_was_compiled_is_not_missing_and_new_models_are() -> None:
    for compile_job in RIG.jobs().values():
        compile_job()
    assert RIG.missing() == ()
    assert RigKernels((), moving=False).missing() == ()


def test_all_is_missing_on_a_fresh_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("maplab_py.algorithms.rig_warmup.is_generated", lambda _: False)
    monkeypatch.setattr("maplab_py.algorithms.rig_warmup.is_missing_on_disk", lambda _: True)
    assert RIG.missing() == tuple(RIG.jobs())
    assert RIG.missing()[0] == REPROJECTION
