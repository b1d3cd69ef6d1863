"""Reprojection of a landmark of a map, whose Jacobians are derived from one expression, as a compiled kernel.

Here and not in `symbolic`, whose files name the folder of all kernels: this residual is compiled for
cameras that are localised in a map, and only then.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from maplab_py.estimation.codegen.kernels import residual_kernel
from maplab_py.sensors.camera import DISTORTION_SIZE, INTRINSICS_SIZE, Distortion, Projection


def map_reprojection_kernel(projection: Projection, distortion: Distortion) -> ModuleType:
    """Return the kernel of `map_reprojection` for a camera model; see `residual_kernel`."""
    name = f"map_reprojection_{projection.name.lower()}_{distortion.name.lower()}_{_digest()}"
    return residual_kernel(name, lambda: map_reprojection(projection, distortion))


def map_reprojection(projection: Projection, distortion: Distortion) -> Any:
    """Return f(T_M_I, T_G_M, T_I_C, parameters, p_G, uv) -> r (2), Jacobian (2 x 15).

    r = projection of the landmark - measured pixel; its columns are the tangents of T_M_I and T_G_M, then
    p_G. Source: Schneider 2019, Paper I, eq. (4.4).
    """
    import casadi

    from maplab_py.estimation.symbolic.cameras import project
    from maplab_py.estimation.symbolic.manifold import (
        PerturbedPose,
        PerturbedVector,
        rotation_matrix,
        with_jacobian,
    )

    ca: Any = casadi  # its stubs do not know mixed arguments
    T_M_I, T_G_M = PerturbedPose("T_M_I"), PerturbedPose("T_G_M")
    p_G, T_I_C, uv = PerturbedVector("p_G", 3), ca.SX.sym("T_I_C", 7), ca.SX.sym("uv", 2)
    size = INTRINSICS_SIZE[projection] + DISTORTION_SIZE[distortion]
    parameters = ca.SX.sym("parameters", size)
    p_M = T_G_M.R.T @ (p_G.x - T_G_M.p)
    p_I = T_M_I.R.T @ (p_M - T_M_I.p)
    p_C = rotation_matrix(T_I_C[:4]).T @ (p_I - T_I_C[4:])
    residual = project(projection, distortion, p_C, parameters) - uv
    tangents = [T_M_I.tangent, T_G_M.tangent, p_G.tangent]
    arguments = [T_M_I.values, T_G_M.values, T_I_C, parameters, p_G.values, uv]
    return ca.Function("map_reprojection", arguments, ca.cse([*with_jacobian(residual, tangents)]))


@cache
def _digest() -> str:
    return hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:8]
