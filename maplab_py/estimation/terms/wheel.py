"""Relative poses of wheel odometry, whose distances have a scale that is estimated."""

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.estimation.blocks import ParameterBlock
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.states import States
from maplab_py.estimation.terms import pose, protocol

WHEEL_SCALE = "wheel scale"
_SMALLEST, _LARGEST = 0.01, 100.0
"""Limits of the scale, far beyond what wheels can be wrong by."""


def wheel_scale_block(scales: F64) -> ParameterBlock:
    """Return the block of scales (S,) of wheel sensors: reported / driven distance."""
    return ParameterBlock(WHEEL_SCALE, scales.reshape(-1, 1), lower=_SMALLEST, upper=_LARGEST)


@dataclasses.dataclass(frozen=True, eq=False)
class ScaledRelativePoseTerm(protocol.FixedMeasurements):
    """Relative poses T_SA_SB whose measured positions are scaled by a state.

    The kernel of the poses is `scaled_relative_pose`, or with a mounting
    `scaled_relative_pose_with_mounting`.
    """

    poses: pose.RelativePoseTerm
    sensor: I64  # (N,) rows of the block of scales
    scale_nodes: I64  # (N, 1)

    @property
    def name(self) -> str:
        """Name in the report."""
        return self.poses.name

    @property
    def loss(self) -> tuple[Loss, float]:
        """Robust loss and its scale in sigmas."""
        return self.poses.loss

    @property
    def nodes(self) -> I64:
        """Nodes (N, 5), or (N, 7) with the mounting's; the scale's is the last."""
        return np.concatenate([self.poses.nodes, self.scale_nodes], axis=1)

    def evaluate(self, states: States) -> tuple[F64, F64]:
        """Return whitened residuals (N, 6) and Jacobians (N, 6, 15 or 21)."""
        scale = np.zeros((len(self.sensor), 3))
        scale[:, 0] = states.blocks[WHEEL_SCALE].values[self.sensor, 0]
        arguments = np.concatenate([self.poses.arguments(states), scale], axis=1)
        return protocol.evaluated(self.poses.kernel, arguments, self.poses.whitening)
