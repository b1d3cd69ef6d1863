"""Residuals that plugins add: a symbolic expression, and rows of data from the map.

Example, a barometer that measures heights::

    @residual("barometer", states=("pose",), data_size=1)
    def barometer(T_G_I, height_m):
        return T_G_I.p[2] - height_m

    @barometer.rows
    def heights(vi_map):
        return ResidualRows(vertices=..., data=..., sigma=0.5)

`optvi --ba_residuals=barometer` then uses it: the expression is differentiated and compiled like
the residuals of the project itself.
"""

import dataclasses
import hashlib
import inspect
import re
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.errors import UserError
from maplab_py.estimation.codegen.kernels import residual_kernel
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.states import (
    ACCEL_BIAS,
    GYRO_BIAS,
    NODES_PER_VERTEX,
    VELOCITY,
    States,
    pose_nodes,
)
from maplab_py.estimation.terms.protocol import FixedMeasurements, evaluated
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap

_VECTORS = {"velocity": VELOCITY, "gyro_bias": GYRO_BIAS, "accel_bias": ACCEL_BIAS}


@dataclasses.dataclass(frozen=True, eq=False)
class ResidualRows:
    """Input of a residual: N measurements."""

    vertices: I64  # (N,) rows of the map's vertices, or (N, 2) for states of two vertices
    data: F64  # (N, data_size)
    sigma: F64 | float  # standard deviation of the residual: one, (m,), or (N, m)


RowsOfMap = Callable[[VIMap], ResidualRows]


class Residual:
    """A residual of a plugin, by name."""

    def __init__(
        self,
        name: str,
        expression: Callable[..., Any],
        states: tuple[str, ...],
        data_size: int,
        loss: tuple[Loss, float],
    ) -> None:
        """Describe a residual; see `residual`."""
        self.name, self.expression, self.loss = name, expression, loss
        self.data_size = data_size
        self.variables = [_variable(name, text) for text in states]
        self._rows: RowsOfMap | None = None

    def rows(self, function: RowsOfMap) -> RowsOfMap:
        """Take the function that reads the measurements from a map; a decorator."""
        self._rows = function
        return function

    def rows_of(self, vi_map: VIMap) -> ResidualRows:
        """Return the map's measurements, checked.

        Raises:
            UserError: The plugin gives none, or of a wrong shape.
        """
        if self._rows is None:
            raise UserError(f"residual {self.name}: no function is decorated with .rows")
        rows = self._rows(vi_map)
        vertices = np.asarray(rows.vertices, dtype=np.int64).reshape(len(rows.data), -1)
        data = np.ascontiguousarray(rows.data, dtype=np.float64).reshape(len(rows.data), -1)
        needed = 1 + max(place for _, place in self.variables)
        if data.shape[1] != self.data_size or vertices.shape[1] != needed:
            raise UserError(
                f"residual {self.name}: rows have {vertices.shape[1]} vertices and "
                f"{data.shape[1]} numbers each, not {needed} and {self.data_size}"
            )
        return ResidualRows(vertices, data, rows.sigma)

    def function(self) -> Any:
        """Return the casadi function (variables..., data) -> residual, Jacobian."""
        import casadi

        from maplab_py.estimation.symbolic.manifold import (
            PerturbedPose,
            PerturbedVector,
            with_jacobian,
        )

        ca: Any = casadi  # its stubs do not know mixed arguments
        symbols: list[Any] = [
            PerturbedPose(f"T_{place}") if kind == "pose" else PerturbedVector(f"{kind}_{place}", 3)
            for kind, place in self.variables
        ]
        data = ca.SX.sym("data", self.data_size)
        handed = [s if isinstance(s, PerturbedPose) else s.x for s in symbols]
        value = self.expression(*handed, data)
        result = ca.vertcat(*value) if isinstance(value, list | tuple) else value
        residual, jacobian = with_jacobian(ca.SX(result), [s.tangent for s in symbols])
        arguments = [*(s.values for s in symbols), data]
        return ca.Function("residual", arguments, ca.cse([residual, jacobian]))

    def kernel(self, progress: Progress = SILENT) -> ModuleType:
        """Return the compiled kernel; the cache knows the expression's source file."""
        source = Path(inspect.getfile(self.expression)).read_bytes()
        digest = hashlib.sha256(source).hexdigest()[:12]
        name = re.sub(r"\W", "_", self.name)
        return residual_kernel(f"plugin_{name}_{digest}", self.function, progress)


REGISTERED: dict[str, Residual] = {}
"""The residuals of all plugins that were imported."""


def residual(
    name: str,
    *,
    states: tuple[str, ...],
    data_size: int,
    loss: tuple[Loss, float] = (Loss.NONE, 1.0),
) -> Callable[[Callable[..., Any]], Residual]:
    """Make a residual of an expression; a decorator.

    The function gets a symbolic argument for every state, then the data (data_size), and returns
    the residual, a casadi expression or a list of scalar ones. A pose has `.p`, `.R` and `.q`, the
    other states are vectors of three; all are in G as everywhere.

    Args:
        name: What `--ba_residuals` and the report call it.
        states: Of pose, velocity, gyro_bias, accel_bias; with the suffix _A or _B for residuals
            between two vertices.
        data_size: Numbers of each measurement.
        loss: Robust loss and its scale in sigmas.
    """

    def decorate(expression: Callable[..., Any]) -> Residual:
        made = Residual(name, expression, states, data_size, loss)
        REGISTERED[name] = made
        return made

    return decorate


def _variable(residual_name: str, text: str) -> tuple[str, int]:
    """Split "pose_B" into the kind and the vertex' place."""
    kind, place = (text[:-2], "AB".index(text[-1])) if text[-2:] in ("_A", "_B") else (text, 0)
    if kind != "pose" and kind not in _VECTORS:
        known = ", ".join(["pose", *_VECTORS])
        raise ValueError(f"residual {residual_name}: no state '{text}'; there are {known}")
    return kind, place


class ExpressionTerm(FixedMeasurements):
    """The factors of one residual."""

    def __init__(self, definition: Residual, kernel: ModuleType, rows: ResidualRows) -> None:
        """Take rows whose vertices are those of the states."""
        self.name, self.loss = definition.name, definition.loss
        self._variables, self._kernel, self._rows = definition.variables, kernel, rows
        self.nodes = np.concatenate([self._nodes(kind, at) for kind, at in self._variables], axis=1)
        sigma = np.broadcast_to(rows.sigma, (len(rows.data), kernel.ROWS))
        self._root = np.ascontiguousarray((1.0 / sigma)[:, :, None] * np.eye(kernel.ROWS))

    def _nodes(self, kind: str, place: int) -> I64:
        vertices = self._rows.vertices[:, place]
        if kind == "pose":
            return pose_nodes(vertices)
        return (NODES_PER_VERTEX * vertices + _VECTORS[kind])[:, None]

    def evaluate(self, states: States) -> tuple[F64, F64]:
        """Return whitened residuals (N, m) and Jacobians (N, m, 3 nodes)."""
        columns = {
            "pose": states.T_G_I,
            "velocity": states.v_G,
            "gyro_bias": states.gyro_bias,
            "accel_bias": states.accel_bias,
        }
        values = [columns[kind][self._rows.vertices[:, at]] for kind, at in self._variables]
        arguments = np.ascontiguousarray(np.concatenate([*values, self._rows.data], axis=1))
        return evaluated(self._kernel, arguments, self._root)
