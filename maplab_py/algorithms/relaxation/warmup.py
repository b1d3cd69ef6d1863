"""Compile the kernels of pose graphs by relaxing a tiny one."""

from __future__ import annotations

import numpy as np

from maplab_py.algorithms.relaxation.graph_files import map_of_graph
from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.algorithms.relaxation.relaxation import relax
from maplab_py.geometry import se3
from maplab_py.interop.g2o import PoseGraph

_POSES = 12


def compile_relaxation() -> None:
    """Relax a map of a circle of poses whose ends meet."""
    T_G_V = se3.identity(_POSES)
    T_G_V[:, 4] = np.sin(2.0 * np.pi * np.arange(_POSES) / _POSES)
    T_G_V[:, 5] = np.cos(2.0 * np.pi * np.arange(_POSES) / _POSES)
    first = np.append(np.arange(_POSES - 1), [0, 1])
    second = np.append(np.arange(1, _POSES), [_POSES - 1, _POSES - 2])
    T_A_B = se3.compose(se3.inverse(T_G_V[first]), T_G_V[second])
    T_A_B[-1, 4] += 0.01
    graph = PoseGraph(
        id=np.arange(_POSES, dtype=np.uint64),
        T_G_V=T_G_V,
        first=first,
        second=second,
        T_A_B=T_A_B,
        information=np.tile(1e4 * np.eye(6), (len(first), 1, 1)),
        fixed=np.zeros(1, dtype=np.int64),
    )
    relax(map_of_graph(graph), RelaxationOptions())
