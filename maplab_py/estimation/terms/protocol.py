"""Terms other than reprojection: factors on the nodes of a few vertices each.

A factor has a residual of size m and touches a list of nodes (three numbers each). Its whitened
Jacobian (m, 3 * nodes) has the columns of the nodes side by side.
"""

from types import ModuleType
from typing import Protocol

from maplab_py.array_types import F64, I64
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.states import States


class FactorTerm(Protocol):
    """Interface of a term; a plugin may bring its own."""

    @property
    def name(self) -> str:
        """Name in the report."""

    @property
    def nodes(self) -> I64:
        """Nodes (N, n) that each factor touches: 5 * vertex + kind, see `states`."""

    @property
    def loss(self) -> tuple[Loss, float]:
        """Robust loss and its scale in sigmas."""

    def relinearize(self, states: States) -> bool:
        """Update data that depend on a linearisation point; return whether costs may have changed.

        The solver calls this before it linearises (see `FixedMeasurements`).
        """

    def evaluate(self, states: States) -> tuple[F64, F64]:
        """Return whitened residuals (N, m) and Jacobians (N, m, 3 n)."""


class FixedMeasurements:
    """Base of terms whose measurements have no linearisation point."""

    def relinearize(self, states: States) -> bool:  # noqa: ARG002
        """Return False: nothing depends on where the solver linearises."""
        return False


def evaluated(kernel: ModuleType, arguments: F64, root_information: F64) -> tuple[F64, F64]:
    """Return whitened residuals (N, m) and Jacobians (N, m, 3 n) of a generated kernel."""
    residual, jacobian = kernel.evaluated(arguments, root_information)
    return residual, jacobian
