"""Kernels that are compiled before anybody waits for them."""

import numpy as np
from numpy.testing import assert_array_equal

from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.algorithms.relaxation.relaxation import relax
from maplab_py.estimation.codegen.kernels import pose_graph_kernels
from maplab_py.estimation.linear import supernodal, supernodal_solver
from maplab_py.estimation.problem.gauge import connected_parts
from maplab_py.estimation.symbolic.sources import PoseError
from maplab_py.estimation.terms.pose_graph import RelativePoses
from maplab_py.geometry import se3
from maplab_py.warmup import jobs
from tests.algorithms.relaxation.loops import simulate


def test_a_relaxation_compiles_nothing_after_the_warmup():
    jobs()["relaxation"]()
    kernels = pose_graph_kernels(PoseError.SPLIT)
    used = (
        connected_parts,
        kernels.normal_equations,
        kernels.cost,
        kernels.add_tilt,
        kernels.linearize,
        kernels.moved,
        supernodal.factorise,
        supernodal_solver.invert_panels,
    )
    before = [list(kernel.signatures) for kernel in used]
    assert all(before)
    loop = simulate(0)
    relax(loop.vi_map, RelaxationOptions(), loop_closures=loop.closures)
    assert [list(kernel.signatures) for kernel in used] == before


def test_edges_that_cannot_be_written_to_compile_nothing_again():
    measured = se3.identity(1)
    rows, weight, poses = np.zeros(1, dtype=np.int64), np.eye(6)[None], se3.identity(1)
    errors = RelativePoses(rows, rows, measured.copy(), weight).errors(poses)
    kernel = pose_graph_kernels(PoseError.SPLIT).linearize
    before = list(kernel.signatures)
    measured.flags.writeable = False
    assert_array_equal(RelativePoses(rows, rows, measured, weight).errors(poses), errors)
    assert list(kernel.signatures) == before
