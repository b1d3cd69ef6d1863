"""Interface of a least-squares problem."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

S = TypeVar("S")
"""States: a value; steps make new ones."""


class Linearized(Protocol):
    """The normal equations at some states; only the problem knows more of them."""

    @property
    def costs(self) -> dict[str, float]:
        """Half the sum of rho of every term."""


L = TypeVar("L", bound=Linearized)


@dataclasses.dataclass(frozen=True, eq=False)
class Step(Generic[S]):
    """States after a step that has not been accepted yet."""

    states: S
    costs: dict[str, float]
    promised: float  # decrease of the cost by the linearised model
    norm: float
    refine: Callable[[], Step[S]] | None = None
    """Solves an iterative step again, more exactly; None = the step is exact."""

    @property
    def cost(self) -> float:
        """Half the sum of all rho."""
        return sum(self.costs.values())


class LeastSquares(Protocol[S, L]):
    """A problem that `solver.optimize_states` minimises."""

    def relinearize(self, states: S) -> bool:
        """Move the terms' linearisation points to the states; return whether costs may have changed."""

    def linearize(self, states: S, damping: float) -> L:
        """Form the normal equations, with damping of the eliminated states."""

    def try_step(self, states: S, linear: L, damping: float) -> Step[S]:
        """Return the damped step from the states at which the equations were formed.

        Raises:
            NotPositiveDefinite: The damped equations are singular.
        """

    def is_stationary(self, linear: L, tolerance: float) -> bool:
        """Return whether the whole gradient is known and no entry is larger than the tolerance."""

    def norm(self, states: S) -> float:
        """Return the norm of all values, for the relative size of a step."""
