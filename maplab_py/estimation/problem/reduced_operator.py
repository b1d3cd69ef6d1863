"""Normal equations as an operator: what is evaluated at some states, and what damping makes of it."""

from __future__ import annotations

import dataclasses

from maplab_py.array_types import F64, I64
from maplab_py.estimation.problem.problem import Linearization
from maplab_py.estimation.states import States
from maplab_py.estimation.terms.visual import Observations
from maplab_py.estimation.terms.visual_products import PoseSystem


@dataclasses.dataclass(frozen=True, eq=False)
class Evaluation:
    """Everything at some states that does not depend on the damping."""

    states: States
    observations: Observations | None
    poses: PoseSystem | None
    gradient: F64  # (nodes, 3) without landmarks' elimination
    diagonal: F64  # (nodes, 3)
    factors: list[tuple[I64, F64, F64]]
    factor_blocks: list[F64]
    costs: dict[str, float]


@dataclasses.dataclass(frozen=True, eq=False)
class ReducedOperator(Linearization):
    """Normal equations of which only the blocks for the preconditioner are formed.

    The next linearisation of the same problem writes into what products read.
    """

    pose_blocks: F64  # (V, 6, 6) diagonal blocks of the visual Schur complement
    factor_blocks: list[F64]
