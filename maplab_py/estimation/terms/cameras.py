"""Cameras as kernels read them, as blocks of the states, and as a border of the system."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from maplab_py.array_types import F64, I32, I64
from maplab_py.estimation.blocks import Manifold, ParameterBlock
from maplab_py.estimation.codegen.kernels import model_code
from maplab_py.estimation.kernels.visual_arguments import VisualSums
from maplab_py.estimation.states import States, pose_nodes
from maplab_py.sensors import Camera

EXTRINSICS, TIMING, INTRINSICS = "camera extrinsics", "camera timing", "camera intrinsics"


@dataclasses.dataclass(frozen=True, eq=False)
class Cameras:
    """C cameras as the kernels read them."""

    T_I_C: F64  # (C, 7)
    parameters: F64  # (C, 1 + widest): code of the model, then intrinsics and distortion

    @classmethod
    def of(cls, cameras: Sequence[Camera], T_I_C: F64) -> Cameras:
        """Return cameras with poses (C, 7)."""
        values = [[*camera.intrinsics, *camera.distortion_parameters] for camera in cameras]
        parameters = np.zeros((len(cameras), 1 + max(map(len, values), default=0)))
        for row, (camera, numbers) in enumerate(zip(cameras, values, strict=True)):
            parameters[row, 0] = model_code(camera.projection, camera.distortion)
            parameters[row, 1 : 1 + len(numbers)] = numbers
        return cls(np.ascontiguousarray(T_I_C, dtype=np.float64), parameters)


def camera_blocks(cameras: Cameras, timing_s: F64) -> tuple[ParameterBlock, ...]:
    """Return the blocks of C cameras, in the order of the kernels' columns.

    Args:
        timing_s: Image delays (C,) or (C, 1); (C, 2) with the time between two rows, for kernels that
            estimate line delays.
    """
    timing_s = np.asarray(timing_s, dtype=np.float64).reshape(len(cameras.T_I_C), -1)
    return (
        ParameterBlock(EXTRINSICS, cameras.T_I_C, Manifold.POSE),
        ParameterBlock(TIMING, timing_s),
        ParameterBlock(INTRINSICS, np.ascontiguousarray(cameras.parameters[:, 1:])),
    )


def camera_nodes(states: States) -> I64:
    """Return the nodes (C, n) of each camera, in the order of the kernels' columns."""
    names = (EXTRINSICS, TIMING, INTRINSICS)
    return np.concatenate([states.nodes(name) for name in names], axis=1)


def pixel_delay_s(timing_s: F64, camera: I32, row_px: F64) -> F64:
    """Return how much later than its vertex each pixel (O,) of a camera (O,) was taken (O,).

    Args:
        timing_s: Image delays (C, 1), or with the time between two rows (C, 2).
        camera: Row of the camera (O,).
        row_px: Row of the image v (O,).
    """
    delay_s = timing_s[camera, 0]
    if timing_s.shape[1] > 1:
        delay_s = delay_s + timing_s[camera, 1] * row_px
    return np.asarray(delay_s)


def border_places(states: States) -> tuple[I64, I64]:
    """Return node row and column of every block of cameras with poses, then with cameras."""
    nodes, num_vertices = camera_nodes(states), len(states.T_G_I)
    shape = (len(nodes), num_vertices, nodes.shape[1], 2)
    border_row = np.broadcast_to(nodes[:, None, :, None], shape)
    border_col = np.broadcast_to(pose_nodes(np.arange(num_vertices))[None, :, None, :], shape)
    flat = nodes.reshape(-1)
    row, col = _lower(flat)
    rows = np.concatenate([border_row.reshape(-1), flat[row]])
    return rows, np.concatenate([border_col.reshape(-1), flat[col]])


def border_values(sums: VisualSums, nodes: I64) -> F64:
    """Return the blocks (B, 3, 3) at `border_places`, from chunk 0 of the sums."""
    count, each = nodes.shape
    border = sums.border[0].reshape(count, -1, each, 3, 2, 3).transpose(0, 1, 2, 4, 3, 5)
    square = sums.camera_square[0].reshape(count, count, each, 3, each, 3)
    by_node = square.transpose(0, 2, 1, 4, 3, 5).reshape(count * each, count * each, 3, 3)
    return np.concatenate([border.reshape(-1, 3, 3), by_node[_lower(nodes.reshape(-1))]])


def _lower(nodes: I64) -> tuple[I64, I64]:
    """Return the pairs of positions whose first node does not come before the second."""
    row, col = np.nonzero(nodes[:, None] >= nodes[None, :])
    return row, col
