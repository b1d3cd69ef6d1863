"""The slow and plain way: a problem as one residual vector, differentiated numerically.

Reprojection uses the camera models of `sensors`, not the compiled kernels; other terms give their
residuals and everything else is done by differences and dense algebra.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.estimation.codegen.kernels import residual_kernel, visual_kernels
from maplab_py.estimation.imu import inertial_data, preintegration
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.problem.problem import Problem
from maplab_py.estimation.states import States
from maplab_py.estimation.symbolic.sources import inertial
from maplab_py.estimation.terms import cameras, protocol
from maplab_py.estimation.terms.inertial import BiasWalkTerm, InertialTerm
from maplab_py.estimation.terms.visual import Observations, VisualTerms
from maplab_py.geometry import se3, so3
from maplab_py.sensors import CameraRig, Imu, projection
from maplab_py.vimap import VIMap
from studies.ekf_tracks import pixel_slopes

F64 = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class DenseProblem:
    """A small map as optimiser terms and as a residual vector."""

    rig: CameraRig
    observations: Observations
    visual: VisualTerms | None
    factors: list[protocol.FactorTerm]
    states: States

    def problem(self) -> Problem:
        """Return the optimiser's problem, nothing fixed."""
        return Problem(self.states, self.visual, self.factors)

    def residuals(self, states: States) -> F64:
        """Return whitened residuals (m,): reprojection, then every term, without robust loss."""
        parts = [] if self.visual is None else [self._reprojection(states).reshape(-1)]
        return np.concatenate(
            parts + [term.evaluate(states)[0].reshape(-1) for term in self.factors]
        )

    def _reprojection(self, states: States) -> F64:
        data = self.observations
        p_G = states.p_G[data.landmark]
        result = np.empty((len(data), 2))
        for row, camera in enumerate(self.rig.cameras):
            own = data.camera == row
            T_G_C = se3.compose(states.T_G_I[data.vertex[own]], self.rig.T_B_C[row])
            uv, visible = projection.project(camera, se3.transform(se3.inverse(T_G_C), p_G[own]))
            assert visible.all()
            result[own] = uv - data.uv_px[own]
        return np.asarray(result * data.inverse_sigma[:, None])

    def jacobian(self, states: States) -> F64:
        """Return the derivative (m, 15 V + 3 L) by nodes and landmarks, of fourth order."""
        count = 15 * len(states.T_G_I) + 3 * len(states.p_G)
        columns = []
        for k in range(count):
            d = np.zeros(count)
            d[k] = 1e-3
            near = self.residuals(moved(states, d)) - self.residuals(moved(states, -d))
            far = self.residuals(moved(states, 2 * d)) - self.residuals(moved(states, -2 * d))
            columns.append((8.0 * near - far) / 12e-3)
        return np.stack(columns, axis=1)

    def exact_jacobian(self, states: States) -> F64:
        """Return the same from the derivatives of camera models and terms; quick."""
        vertices, data = len(states.T_G_I), self.observations
        seen = 0 if self.visual is None else 2 * len(data)
        J = np.zeros((len(self.residuals(states)), 15 * vertices + 3 * len(states.p_G)))
        if seen:
            rows = np.arange(seen).reshape(-1, 2)[:, :, None]
            pose, point = self._reprojection_derivatives(states)
            J[rows, (15 * data.vertex)[:, None, None] + np.arange(6)] = pose
            J[rows, (15 * vertices + 3 * data.landmark)[:, None, None] + np.arange(3)] = point
        for term in self.factors:
            _, by_nodes = term.evaluate(states)
            count, size, _ = by_nodes.shape
            columns = (3 * term.nodes[:, :, None] + np.arange(3)).reshape(count, 1, -1)
            J[seen + np.arange(count * size).reshape(count, size, 1), columns] = by_nodes
            seen += count * size
        return J

    def _reprojection_derivatives(self, states: States) -> tuple[F64, F64]:
        """Return derivatives (O, 2, 6) by poses and (O, 2, 3) by landmarks, whitened."""
        data = self.observations
        pose, point = np.empty((len(data), 2, 6)), np.empty((len(data), 2, 3))
        for row, camera in enumerate(self.rig.cameras):
            own = data.camera == row
            T_G_I = states.T_G_I[data.vertex[own]]
            p_I = se3.transform(se3.inverse(T_G_I), states.p_G[data.landmark[own]])
            T_C_I = se3.inverse(self.rig.T_B_C[row])
            by_p_C = pixel_slopes(camera, se3.transform(T_C_I, p_I))
            by_p_I = by_p_C @ so3.to_matrix(T_C_I[:4])
            point[own] = by_p_I @ so3.to_matrix(so3.inverse(T_G_I[:, :4]))
            pose[own, :, :3] = -point[own]
            pose[own, :, 3:] = by_p_I @ so3.skew(p_I)
        weight = data.inverse_sigma[:, None, None]
        return pose * weight, point * weight

    def minimum(self, states: States, iterations: int = 8) -> tuple[States, float]:
        """Return states and cost after Gauss-Newton with the pseudo-inverse: nothing is fixed."""
        for _ in range(iterations):
            J, r = self.exact_jacobian(states), self.residuals(states)
            scale = np.maximum(np.linalg.norm(J, axis=0), 1e-9)
            step = -np.linalg.lstsq(J / scale, r, rcond=1e-9)[0] / scale
            states = moved(states, step)
        return states, 0.5 * float(np.sum(self.residuals(states) ** 2))


def moved(states: States, step: F64) -> States:
    """Apply a step (15 V + 3 L,) by nodes, then landmarks."""
    vertices = len(states.T_G_I)
    nodes, points = step[: 15 * vertices], step[15 * vertices :]
    return states.moved(nodes.reshape(-1, 3), states.p_G + points.reshape(-1, 3))


def dense_problem(
    vi_map: VIMap,
    *,
    include_visual: bool = True,
    include_inertial: bool = True,
    loss: Loss = Loss.NONE,
    loss_scale: float = 3.0,
    move_points: bool = True,
) -> DenseProblem:
    """Return the problem of a map whose missions share one rig and one IMU."""
    sensors = vi_map.sensors.sensors.values()
    rig = next(s for s in sensors if isinstance(s, CameraRig))
    imu = next(s for s in sensors if isinstance(s, Imu))
    q_G_M = vi_map.T_G_M[vi_map.vertices.mission, :4]
    states = States(
        np.ascontiguousarray(vi_map.T_G_I),
        so3.rotate(q_G_M, vi_map.vertices.v_M),
        vi_map.vertices.gyro_bias,
        vi_map.vertices.accel_bias,
        np.ascontiguousarray(vi_map.p_G),
    )
    keypoints = vi_map.observations
    observations = Observations(
        start=vi_map.observation_start,
        vertex=vi_map.keypoint_vertex[keypoints].astype(np.int32),
        camera=vi_map.frames.camera_index[vi_map.keypoint_frame[keypoints]].astype(np.int32),
        uv_px=np.ascontiguousarray(vi_map.keypoints.uv_px[keypoints]),
        inverse_sigma=1.0 / vi_map.keypoints.sigma_px[keypoints],
        loss_scale=np.full(len(keypoints), loss_scale),
    )
    visual = None
    if include_visual:
        visual = VisualTerms(
            visual_kernels(),
            observations,
            cameras.Cameras.of(rig.cameras, rig.T_B_C),
            len(vi_map.vertices),
            loss=loss,
            move_points=move_points,
        )
    factors = _inertial(vi_map, imu) if include_inertial else []
    return DenseProblem(rig, observations, visual, factors, states)


def _inertial(vi_map: VIMap, imu: Imu) -> list[protocol.FactorTerm]:
    edges = vi_map.imu_edges
    data = inertial_data.InertialData.of_map(vi_map)
    first, second = edges.from_vertex.astype(np.int64), edges.to_vertex.astype(np.int64)
    g_G = np.tile([0.0, 0.0, -imu.gravity_magnitude_mps2], (len(edges), 1))
    walk = preintegration.integrate(data, np.zeros(3), np.zeros(3))
    term = InertialTerm(residual_kernel("inertial", inertial), data, first, second, g_G)
    return [
        term,
        BiasWalkTerm(first, second, walk.gyro_walk_variance, walk.accel_walk_variance),
    ]
