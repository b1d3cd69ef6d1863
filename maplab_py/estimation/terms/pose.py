"""Relative and absolute pose measurements as factor terms."""

from __future__ import annotations

import dataclasses
from types import ModuleType

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.estimation.blocks import Manifold, ParameterBlock
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.states import States, pose_nodes
from maplab_py.estimation.terms.protocol import FixedMeasurements, evaluated
from maplab_py.geometry import symmetric

MOUNTING, SWITCH = "sensor extrinsics", "loop closure switch"

_SMALLEST_VARIANCE = 1e-14


def whitening(covariance: F64) -> F64:
    """Return W (N, 6, 6) with W' W = covariance^-1; variances are kept above 1e-14.

    Covariances that are not numbers count as the identity.
    """
    usable = np.isfinite(covariance).all(axis=(1, 2), keepdims=True)
    clean = np.where(usable, covariance, np.eye(6))
    return symmetric.whitening(clean, _SMALLEST_VARIANCE)


def mounting_block(T_I_S: F64) -> ParameterBlock:
    """Return the block of sensors' extrinsics T_I_S (S, 7)."""
    return ParameterBlock(MOUNTING, T_I_S, Manifold.POSE)


def switch_block(switches: F64) -> ParameterBlock:
    """Return the block of switches (N,), which stay within [0, 1]."""
    return ParameterBlock(SWITCH, switches.reshape(-1, 1), lower=0.0, upper=1.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Mounting:
    """Places of the extrinsics of measurements: rows (N,) of a block of the states."""

    block: str
    row: I64
    nodes: I64  # (N, 2)

    @classmethod
    def of(cls, states: States, row: I64, block: str = MOUNTING) -> Mounting:
        """Refer to rows (N,) of a block of the states."""
        return cls(block, row, states.nodes(block)[row])

    def T_I_S(self, states: States) -> F64:
        """Return the extrinsics (N, 7)."""
        return np.asarray(states.blocks[self.block].values[self.row])


@dataclasses.dataclass(frozen=True, eq=False)
class RelativePoseTerm(FixedMeasurements):
    """Measured relative poses T_SA_SB of a sensor between two vertices: odometry, loop closures.

    With a mounting the extrinsics are states and the kernel is `relative_pose_with_mounting`.
    """

    kernel: ModuleType
    name: str
    first: I64  # (N,) vertex rows
    second: I64  # (N,)
    T_I_S: F64  # (N, 7)
    T_SA_SB: F64  # (N, 7)
    whitening: F64  # (N, 6, 6)
    loss: tuple[Loss, float] = (Loss.NONE, 1.0)
    mounting: Mounting | None = None

    @property
    def nodes(self) -> I64:
        """Nodes (N, 4), or (N, 6) with the mounting's."""
        more = [] if self.mounting is None else [self.mounting.nodes]
        return np.concatenate([pose_nodes(self.first), pose_nodes(self.second), *more], axis=1)

    def arguments(self, states: States) -> F64:
        """Return the kernel's arguments (N, 28)."""
        poses = states.T_G_I
        T_I_S = self.T_I_S if self.mounting is None else self.mounting.T_I_S(states)
        return np.concatenate([poses[self.first], poses[self.second], T_I_S, self.T_SA_SB], 1)

    def evaluate(self, states: States) -> tuple[F64, F64]:
        """Return whitened residuals (N, 6) and Jacobians (N, 6, 12 or 18)."""
        return evaluated(self.kernel, self.arguments(states), self.whitening)


@dataclasses.dataclass(frozen=True, eq=False)
class SwitchedRelativePoseTerm(FixedMeasurements):
    """Relative poses T_A_B with switch variables, states in `switch_block`, that reduce their weight.

    A prior on the switches (`PriorTerm` at 1) keeps those of consistent measurements on.
    """

    kernel: ModuleType
    name: str
    first: I64
    second: I64
    T_A_B: F64
    whitening: F64
    switch: I64  # (N,) rows of the block
    switch_nodes: I64  # (N, 1)
    loss: tuple[Loss, float] = (Loss.NONE, 1.0)

    @property
    def nodes(self) -> I64:
        """Nodes (N, 5)."""
        poses = [pose_nodes(self.first), pose_nodes(self.second)]
        return np.concatenate([*poses, self.switch_nodes], axis=1)

    def evaluate(self, states: States) -> tuple[F64, F64]:
        """Return whitened residuals (N, 6) and Jacobians (N, 6, 15)."""
        poses = states.T_G_I
        switch = np.zeros((len(self.first), 3))
        switch[:, 0] = states.blocks[SWITCH].values[self.switch, 0]
        arguments = np.concatenate([poses[self.first], poses[self.second], switch, self.T_A_B], 1)
        return evaluated(self.kernel, arguments, self.whitening)


@dataclasses.dataclass(frozen=True, eq=False)
class AbsolutePoseTerm(FixedMeasurements):
    """Measured poses T_G_S of a sensor at vertices.

    With a mounting the extrinsics are states and the kernel is `absolute_pose_with_mounting`.
    """

    kernel: ModuleType
    vertex: I64  # (N,)
    T_I_S: F64  # (N, 7)
    T_G_S: F64  # (N, 7)
    whitening: F64  # (N, 6, 6)
    loss: tuple[Loss, float] = (Loss.NONE, 1.0)
    name: str = "absolute pose"
    mounting: Mounting | None = None

    @property
    def nodes(self) -> I64:
        """Nodes (N, 2), or (N, 4) with the mounting's."""
        more = [] if self.mounting is None else [self.mounting.nodes]
        return np.concatenate([pose_nodes(self.vertex), *more], axis=1)

    def evaluate(self, states: States) -> tuple[F64, F64]:
        """Return whitened residuals (N, 6) and Jacobians (N, 6, 6 or 12)."""
        T_I_S = self.T_I_S if self.mounting is None else self.mounting.T_I_S(states)
        arguments = np.concatenate([states.T_G_I[self.vertex], T_I_S, self.T_G_S], axis=1)
        return evaluated(self.kernel, arguments, self.whitening)
