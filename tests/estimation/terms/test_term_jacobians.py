"""Terms with calibration states, switches and priors: Jacobians against central differences."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.estimation.blocks import Manifold, ParameterBlock
from maplab_py.estimation.codegen.kernels import residual_kernel
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.states import ACCEL_BIAS, GYRO_BIAS, VELOCITY, States
from maplab_py.estimation.symbolic import sources
from maplab_py.estimation.terms.inertial_calibration import CalibratingInertialTerm, imu_blocks
from maplab_py.estimation.terms.pose import (
    SWITCH,
    AbsolutePoseTerm,
    Mounting,
    RelativePoseTerm,
    SwitchedRelativePoseTerm,
    mounting_block,
    switch_block,
)
from maplab_py.estimation.terms.prior import BlockPrior, PosePrior, VertexVectorPrior
from maplab_py.estimation.terms.protocol import FactorTerm
from maplab_py.estimation.terms.wheel import (
    WHEEL_SCALE,
    ScaledRelativePoseTerm,
    wheel_scale_block,
)
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Imu
from maplab_py.sensors.imu import ImuIntrinsics
from tests.estimation.dense import numeric_jacobian, term_jacobian
from tests.estimation.imu.motion import sampled


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def states(rng: np.random.Generator, vertices: int = 3) -> States:
    def vectors(scale: float) -> np.ndarray:
        return rng.normal(0, scale, (vertices, 3))

    poses = se3.make(so3.exp(vectors(1.0)), vectors(2.0))
    return States(poses, vectors(1.0), vectors(0.01), vectors(0.1), np.zeros((0, 3)))


def check(term: FactorTerm, at: States, step: float = 1e-6, tolerance: float = 1e-6) -> None:
    found = term_jacobian(term, at)
    wanted = numeric_jacobian(lambda moved: term.evaluate(moved)[0], at, step)
    np.testing.assert_allclose(found, wanted, atol=tolerance * np.abs(wanted).max())


@pytest.mark.parametrize("angle", [0.0, 1e-7, 0.4])
def test_inertial_edges_with_imu_intrinsics(rng: np.random.Generator, angle: float) -> None:
    intrinsics = ImuIntrinsics(
        T_g=np.array([[1.01, 0.02, -0.01], [0, 0.98, 0.015], [0, 0, 1.03]]),
        T_a=np.array([[0.97, -0.01, 0.02], [0, 1.02, 0.01], [0, 0, 0.99]]),
        R_A_I=so3.to_matrix(so3.exp(np.array([0.3, -0.2, 1.0]) * angle)),
    )
    imu = Imu("0" * 32, intrinsics=intrinsics)
    stamps, readings = sampled(0.3, 200)
    data = InertialData(
        np.array([0, 31, 61]), stamps, readings, (imu,), np.zeros(2, dtype=np.int64)
    )
    at = states(rng).with_blocks(*imu_blocks((imu,)))
    kernel = residual_kernel("inertial_with_intrinsics", sources.inertial_with_intrinsics)
    first, second = np.array([0, 1]), np.array([1, 2])
    gravity = np.tile([0.0, 0.0, -9.81], (2, 1))
    term = CalibratingInertialTerm(kernel, data, first, second, gravity, at)
    term.relinearize(at)
    check(term, at)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 1.0])
def test_poses_of_mounted_sensors(rng: np.random.Generator, angle: float) -> None:
    T_I_S = se3.make(so3.exp(angle * rng.normal(size=(2, 3))), rng.normal(size=(2, 3)))
    at = states(rng).with_blocks(mounting_block(T_I_S))
    W = rng.normal(size=(2, 6, 6))
    mounting = Mounting.of(at, np.array([1, 0]))
    measured = se3.make(so3.exp(rng.normal(size=(2, 3))), rng.normal(size=(2, 3)))
    relative = residual_kernel("relative_pose_with_mounting", sources.relative_pose_with_mounting)
    ends = np.array([0, 1]), np.array([1, 2])
    check(RelativePoseTerm(relative, "odometry", *ends, T_I_S, measured, W, mounting=mounting), at)
    absolute = residual_kernel("absolute_pose_with_mounting", sources.absolute_pose_with_mounting)
    check(AbsolutePoseTerm(absolute, ends[0], T_I_S, measured, W, mounting=mounting), at)


@pytest.mark.parametrize("has_mounting", [False, True])
def test_wheels_of_unknown_scale(rng: np.random.Generator, has_mounting: bool) -> None:
    T_I_S = se3.make(so3.exp(rng.normal(size=(2, 3))), rng.normal(size=(2, 3)))
    at = states(rng).with_blocks(mounting_block(T_I_S), wheel_scale_block(np.array([1.02, 0.9])))
    W = rng.normal(size=(2, 6, 6))
    measured = se3.make(so3.exp(rng.normal(size=(2, 3))), rng.normal(size=(2, 3)))
    name = "scaled_relative_pose" + ("_with_mounting" if has_mounting else "")
    kernel = residual_kernel(name, getattr(sources, name))
    mounting = Mounting.of(at, np.array([1, 0])) if has_mounting else None
    ends = np.array([0, 1]), np.array([1, 2])
    poses = RelativePoseTerm(kernel, "wheels", *ends, T_I_S, measured, W, mounting=mounting)
    sensor = np.array([1, 0])
    check(ScaledRelativePoseTerm(poses, sensor, at.nodes(WHEEL_SCALE)[sensor]), at)


def test_switched_relative_poses(rng: np.random.Generator) -> None:
    at = states(rng).with_blocks(switch_block(np.array([0.7, 0.3])))
    kernel = residual_kernel("switched_relative_pose", sources.switched_relative_pose)
    measured = se3.make(so3.exp(rng.normal(size=(2, 3))), rng.normal(size=(2, 3)))
    W = rng.normal(size=(2, 6, 6))
    rows = np.array([0, 1])
    term = SwitchedRelativePoseTerm(
        kernel, "loop", np.array([0, 1]), np.array([2, 2]), measured, W, rows, at.nodes(SWITCH)
    )
    check(term, at)


def test_an_open_switch_is_the_relative_pose_itself(rng: np.random.Generator) -> None:
    at = states(rng).with_blocks(switch_block(np.ones(1)))
    measured, W = se3.identity(1), np.eye(6)[None]
    ends = np.array([0]), np.array([2])
    switched = SwitchedRelativePoseTerm(
        residual_kernel("switched_relative_pose", sources.switched_relative_pose),
        "loop", *ends, measured, W, np.array([0]), at.nodes(SWITCH),
    )  # fmt: skip
    plain = RelativePoseTerm(
        residual_kernel("relative_pose", sources.relative_pose),
        "loop", *ends, se3.identity(1), measured, W,
    )  # fmt: skip
    np.testing.assert_allclose(switched.evaluate(at)[0], plain.evaluate(at)[0], atol=1e-12)


@pytest.mark.parametrize("manifold", list(Manifold))
def test_priors_of_blocks(rng: np.random.Generator, manifold: Manifold) -> None:
    tangent = rng.normal(0, 0.8, (3, 6))
    values = {
        Manifold.VECTOR: tangent[:, :4],
        Manifold.POSE: se3.make(so3.exp(tangent[:, 3:]), tangent[:, :3]),
        Manifold.ROTATION: so3.exp(tangent[:, :3]),
    }[manifold]
    at = states(rng).with_blocks(ParameterBlock("thing", values, manifold))
    size = at.blocks["thing"].dimension
    reference = at.blocks["thing"].moved(rng.normal(0, 0.5, (at.blocks["thing"].num_nodes, 3)))
    root = rng.normal(size=(2, size, size))
    rows = np.array([2, 0])
    check(BlockPrior(at, "thing", reference.values[rows], root, rows), at)


def test_priors_of_vertices(rng: np.random.Generator) -> None:
    at = states(rng)
    rows = np.array([2, 1])
    near = se3.retract(at.T_G_I[rows], rng.normal(0, 0.7, (2, 6)))
    check(PosePrior(rows, near, rng.normal(size=(2, 6, 6))), at)
    for kind in (VELOCITY, GYRO_BIAS, ACCEL_BIAS):
        check(VertexVectorPrior(kind, rows, rng.normal(size=(2, 3)), 0.3), at)


def test_a_prior_at_the_state_costs_nothing(rng: np.random.Generator) -> None:
    at = states(rng)
    residual = PosePrior(np.array([1]), at.T_G_I[[1]], np.eye(6)).evaluate(at)[0]
    np.testing.assert_allclose(residual, 0.0, atol=1e-12)
    moved = dataclasses.replace(at, v_G=at.v_G + np.array([0.0, 0.0, 3.0]))
    prior = VertexVectorPrior(VELOCITY, np.array([0]), at.v_G[[0]], 1.5)
    np.testing.assert_allclose(prior.evaluate(moved)[0], [[0.0, 0.0, 2.0]])
