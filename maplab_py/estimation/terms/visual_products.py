"""The reduced system of the visual terms as an operator: kept Jacobians, products, diagonal blocks."""

import dataclasses

import numpy as np

from maplab_py.array_types import F64
from maplab_py.estimation.kernels import schur_products
from maplab_py.estimation.states import States
from maplab_py.estimation.terms.visual import VisualTerms
from maplab_py.memory import require_memory

_NUMBERS_KEPT = 12  # per observation, in single precision
_BYTES_PER_LANDMARK, _BYTES_PER_VERTEX = 8 * (6 + 3 + 6), 8 * 6 * 8


@dataclasses.dataclass(frozen=True, eq=False)
class PoseSystem:
    """Gradient and diagonal blocks of the poses, before or after the landmarks are eliminated."""

    blocks: F64  # (V, 6, 6)
    gradient: F64  # (V, 6)


class VisualProducts:
    """Keeps the Jacobians of visual terms (12 float32 an observation) and multiplies with them.

    `evaluate` at some states, then `eliminate` with a damping of the landmarks, then `multiply` any
    number of times.
    """

    def __init__(self, visual: VisualTerms) -> None:
        """Make room for the Jacobians.

        Raises:
            NotEnoughMemory: They do not fit.
        """
        self._visual = visual
        data, chunks, vertices = visual.observations, visual.num_chunks, visual.num_vertices
        landmarks = len(data.start) - 1
        needed = 4 * _NUMBERS_KEPT * len(data) + _BYTES_PER_LANDMARK * landmarks
        needed += chunks * _BYTES_PER_VERTEX * vertices
        require_memory(float(needed), "the Jacobians of the reprojection errors")
        longest = int(np.diff(data.start).max(initial=0))
        self._structure = schur_products.Structure(
            data.start, data.vertex, visual.chunk_start, longest
        )
        self._kept = schur_products.KeptSystem(
            np.zeros((len(data), _NUMBERS_KEPT), dtype=np.float32),
            np.zeros((landmarks, 6)),
            np.zeros((landmarks, 3)),
            np.zeros((landmarks, 6)),
        )
        self._sums = schur_products.PoseSums(
            np.zeros((chunks, vertices, 6, 6)), np.zeros((chunks, vertices, 6))
        )
        self._products = np.zeros((chunks, vertices, 6))

    def evaluate(self, states: States) -> tuple[PoseSystem, float]:
        """Keep the Jacobians at the states; return the poses' equations and the cost."""
        self._clear()
        cost = self._visual.keep_jacobians(states, self._kept, self._sums)
        return self._sum_of_chunks(), cost

    def eliminate(self, evaluated: PoseSystem, damping: float) -> PoseSystem:
        """Return the poses' equations without the landmarks, which are damped.

        The landmarks' factors stay for `multiply`. Landmarks that do not move leave everything as
        it is: their factors are zero.
        """
        if not self._visual.moves_points:
            self._kept.landmark_factor.fill(0.0)
            return evaluated
        schur_products.factor_landmarks(
            self._kept.landmark_square, damping, self._kept.landmark_factor
        )
        self._clear()
        schur_products.eliminate_landmarks(self._structure, self._kept, *self._sums)
        change = self._sum_of_chunks()
        return PoseSystem(evaluated.blocks + change.blocks, evaluated.gradient + change.gradient)

    def multiply(self, x: F64) -> F64:
        """Return S x (V, 6) for steps x (V, 6) of the poses."""
        self._products.fill(0.0)
        schur_products.multiply(
            self._structure, self._kept, np.ascontiguousarray(x), self._products
        )
        return np.asarray(self._products.sum(axis=0))

    def _clear(self) -> None:
        for part in self._sums:
            part.fill(0.0)

    def _sum_of_chunks(self) -> PoseSystem:
        return PoseSystem(self._sums.square.sum(axis=0), self._sums.gradient.sum(axis=0))
