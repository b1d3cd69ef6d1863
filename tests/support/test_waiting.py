"""Waiting for a condition ends when it holds, or at the latest when told."""

from __future__ import annotations

import itertools

from tests.support.waiting import wait_until


def test_waiting_ends_with_the_condition_or_the_time() -> None:
    numbers = itertools.count()
    assert wait_until(lambda: next(numbers) == 3)
    assert not wait_until(lambda: False, at_most_s=0.02)
