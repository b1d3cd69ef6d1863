"""Workers are processes that stay: what they make, and what becomes of those that die."""

import dataclasses
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from maplab_py.pipeline.messages import Ending
from maplab_py.server import worker as worker_module
from maplab_py.server.preparation import WorkerPool
from maplab_py.server.worker import SubmapOrder, answer
from maplab_py.storage.native import load_map, save_map
from maplab_py.vimap import LandmarkQuality
from tests.server.support import submaps
from tests.support.waiting import wait_until


@pytest.fixture
def order(tmp_path: Path) -> SubmapOrder:
    save_map(submaps("ant")[0], tmp_path / "submap")
    return SubmapOrder(
        title="ant/submap_0",
        submap=tmp_path / "submap",
        result=tmp_path / "prepared",
        log=tmp_path / "worker.log",
        absolute_pose_gate_sigma=5.0,
        ties_stationary=False,
        max_rotation_rad=0.15,
        max_translation_m=0.1,
    )


@pytest.fixture
def pool() -> Iterator[WorkerPool]:
    pool = WorkerPool(1)
    yield pool
    pool.stop()


def never() -> bool:
    return False


def process_of(log: Path) -> int:
    """Return the process that has written its number to a log."""
    return int(log.read_text().split("process ")[1].split()[0])


def test_a_worker_optimises_and_stays_for_the_next_submap(
    order: SubmapOrder, pool: WorkerPool
) -> None:
    assert pool.run(order, never).ending is Ending.DONE
    prepared, _ = load_map(order.result)
    original, _ = load_map(order.submap)
    assert (prepared.landmarks.quality != LandmarkQuality.UNKNOWN).all()
    assert (prepared.vertices.T_M_I != original.vertices.T_M_I).any()
    first = process_of(order.log)
    order.log.unlink()
    assert pool.run(order, never).ending is Ending.DONE
    assert process_of(order.log) == first
    assert "iterations" in order.log.read_text()


def test_a_damaged_submap_is_refused_and_the_worker_stays(
    order: SubmapOrder, pool: WorkerPool, tmp_path: Path
) -> None:
    save_map(submaps("ant")[0], tmp_path / "damaged")
    (tmp_path / "damaged" / "vi_map" / "vertices0").write_bytes(b"damaged")
    damaged = dataclasses.replace(order, submap=tmp_path / "damaged")
    outcome = pool.run(damaged, never)
    assert outcome.ending is Ending.REFUSED
    assert "vertices0" in outcome.error
    first = process_of(order.log)
    assert outcome.error in order.log.read_text()
    order.log.unlink()
    assert pool.run(order, never).ending is Ending.DONE
    assert process_of(order.log) == first


def test_a_killed_worker_is_replaced(order: SubmapOrder, pool: WorkerPool) -> None:
    pool.run(order, never)
    first = process_of(order.log)
    order.log.unlink()

    def kills() -> bool:
        os.kill(first, signal.SIGKILL)
        return False

    os.kill(first, signal.SIGSTOP)  # so that it cannot have answered
    outcome = pool.run(order, kills)
    assert outcome.ending is Ending.OVER_MEMORY
    assert outcome.error == "was killed, as the system does when memory runs out"
    assert pool.run(order, never).ending is Ending.DONE
    assert process_of(order.log) != first


def test_a_cancelled_order_ends_its_worker(order: SubmapOrder, pool: WorkerPool) -> None:
    assert pool.run(order, lambda: True).ending is Ending.CANCELLED
    assert not order.result.exists()
    assert pool.run(order, never).ending is Ending.DONE


def test_a_worker_that_has_ended_for_want_of_orders_costs_no_order(
    order: SubmapOrder,
) -> None:
    pool = WorkerPool(1, idle_s=0.05)
    try:
        pool.run(order, never)
        first = process_of(order.log)
        assert wait_until(lambda: _has_ended(first))
        order.log.unlink()
        assert pool.run(order, never).ending is Ending.DONE
        assert process_of(order.log) != first
    finally:
        pool.stop()


def _has_ended(process: int) -> bool:
    """Tell whether a child of this process has ended; it is not waited for."""
    kind, flags = os.P_PID, os.WEXITED | os.WNOHANG | os.WNOWAIT
    return os.waitid(kind, process, flags) is not None


def test_an_error_of_the_program_is_no_fault_of_the_submap(
    order: SubmapOrder, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(_: SubmapOrder) -> str:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr(worker_module, "prepare", broken)
    assert answer(order) == (Ending.FAILED, "ZeroDivisionError: division by zero")
    assert "Traceback" in caplog.text
