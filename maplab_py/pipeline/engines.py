"""Execution of orders, here in this process one after another."""

from collections import deque
from typing import Self

from maplab_py.pipeline import execution, messages


class Engine:
    """Runs orders in turn, and returns outcomes in the order in which they end."""

    address = ""
    """Page that shows what runs; empty where there is none."""

    def __init__(self) -> None:
        self._orders: deque[messages.Order] = deque()

    def slots(self) -> int:
        """Return how many orders run at the same time."""
        return 1

    def slots_per_host(self) -> int:
        """Return the largest number of orders that run on a machine at the same time."""
        return 1

    def share_gb(self) -> float:
        """Return the memory of a task when all slots are taken [GB]; 0 = no limit."""
        return 0.0

    def submit(self, order: messages.Order) -> None:
        """Take an order."""
        self._orders.append(order)

    def next_outcome(self) -> messages.Outcome:
        """Wait until an order ends.

        Raises:
            MaplabError: The scheduler is lost.
        """
        return execution.execute(self._orders.popleft())

    def __enter__(self) -> Self:
        """Start."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop all orders and everything that was started."""
