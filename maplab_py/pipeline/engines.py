"""Execution of orders: in this process one after another, or on the workers of Dask."""

from collections import deque
from typing import Protocol, Self

from maplab_py.pipeline import execution, messages
from maplab_py.pipeline.options import PipelineOptions


class Engine(Protocol):
    """Runs orders and returns outcomes in the order in which they end."""

    address: str  # of a page that shows what runs; empty where there is none

    def slots(self) -> int:
        """Return how many orders run at the same time."""

    def slots_per_host(self) -> int:
        """Return the largest number of orders that run on a machine at the same time."""

    def share_gb(self) -> float:
        """Return the memory of a task when all slots are taken [GB]; 0 = no limit."""

    def submit(self, order: messages.Order) -> None:
        """Take an order."""

    def next_outcome(self) -> messages.Outcome:
        """Wait until an order ends.

        Raises:
            MaplabError: The scheduler is lost.
        """

    def __enter__(self) -> Self:
        """Start."""

    def __exit__(self, *_: object) -> None:
        """Stop all orders and everything that was started."""


class SequentialEngine:
    """Runs orders in turn, without Dask."""

    address = ""

    def __init__(self) -> None:
        self._orders: deque[messages.Order] = deque()

    def slots(self) -> int:
        """Return 1."""
        return 1

    def slots_per_host(self) -> int:
        """Return 1."""
        return 1

    def share_gb(self) -> float:
        """Return 0: the task has the machine."""
        return 0.0

    def submit(self, order: messages.Order) -> None:
        """Take an order."""
        self._orders.append(order)

    def next_outcome(self) -> messages.Outcome:
        """Run the next order."""
        return execution.execute(self._orders.popleft())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._orders.clear()


def engine_of(options: PipelineOptions) -> Engine:
    """Return the engine that `--scheduler` asks for.

    Raises:
        UserError: Dask is not installed.
    """
    if options.scheduler == "none":
        return SequentialEngine()
    from maplab_py.pipeline.cluster import Cluster

    return Cluster(options)
