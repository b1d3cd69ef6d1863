"""Services: processes that answer requests, and end with the one that asks."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from maplab_py import child_processes
from maplab_py.child_processes import Service, ServiceEnded
from maplab_py.errors import Cancelled


@pytest.fixture
def service() -> Iterator[Service]:
    service = Service("tests.support.echo_service")
    yield service
    service.end()


def test_requests_and_answers_survive_the_way(service: Service) -> None:
    request = {"path": Path("a\nb \udcff"), "x": np.arange(5.0), "none": np.zeros((0, 3))}
    for _ in range(2):
        answer = service.ask(request)
        assert answer["path"] == request["path"]
        np.testing.assert_array_equal(answer["x"], np.arange(5.0))
        assert answer["none"].shape == (0, 3)
        assert answer["x"].flags.writeable
    assert service.is_alive


def test_the_status_of_a_service_that_ends_is_told(service: Service) -> None:
    with pytest.raises(ServiceEnded) as caught:
        service.ask(7)
    assert caught.value.status == 7
    with pytest.raises(ServiceEnded):
        service.ask("again")
    assert not service.is_alive


def test_a_cancelled_request_ends_the_service(service: Service) -> None:
    with pytest.raises(Cancelled):
        service.ask(60.0, lambda: True)
    assert not service.is_alive


def test_a_fault_of_the_asker_is_not_taken_for_the_end_of_the_service(service: Service) -> None:
    def fail() -> bool:
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        service.ask(60.0, fail)
    assert not service.is_alive


def test_a_service_that_only_hangs_up_is_killed(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(child_processes, "_SECONDS_TO_END", 0.2)
    with pytest.raises(ServiceEnded):
        service.ask("hang up")
    assert not service.is_alive
