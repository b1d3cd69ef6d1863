"""Observations of landmarks of a map by the frames of a window, whose base frame T_G_M is estimated.

The residual is e = (proj(T_C_I T_I_M T_M_G p_G) - z) / sigma (Schneider 2019, Paper I, eq. 4.4). A
compiled kernel evaluates it; a window has few of them, so array operations do the rest. The landmark p_G
is known, or a state with a prior N(p_G, Sigma_G) that is eliminated with all its observations, so that
several views of a wrong landmark are not independent facts.
"""

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I32, I64, Mask
from maplab_py.estimation.codegen.kernels import window_kernels
from maplab_py.estimation.kernels import map_observations as kernels
from maplab_py.estimation.kernels import window_arguments
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.terms.cameras import Cameras
from maplab_py.estimation.window.options import WindowOptions
from maplab_py.estimation.window.states import WindowStates
from maplab_py.geometry import so3
from maplab_py.sensors import Camera
from maplab_py.sensors.projection import visibility_limits

_BEHIND = 1e4
"""Squared whitened residual of a landmark that the camera cannot see: an outlier of a fixed size."""


@dataclasses.dataclass(frozen=True, eq=False)
class MapObservations:
    """O observations of A landmarks of a map, those of a landmark in a row; each has at least one."""

    start: I64  # (A + 1,) offsets by landmark
    frame: I32  # (O,) of the window
    camera: I32  # (O,)
    uv_px: F64  # (O, 2)
    sigma_px: F64  # (O,)
    p_G: F64  # (A, 3) as the map has them
    information_G: F64 | None  # (A, 3, 3) of the landmarks [1/m^2]; None = they are known exactly

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def landmark(self) -> I64:
        """Landmark row of every observation (O,)."""
        return np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))


@dataclasses.dataclass(frozen=True, eq=False)
class MapResiduals:
    """Whitened residuals with exact Jacobians; zero where the camera cannot see the landmark."""

    residual: F64  # (O, 2)
    jacobian: F64  # (O, 2, 15) by [p, theta] of T_M_I, then of T_G_M, and by p_G
    is_visible: Mask  # (O,)


@dataclasses.dataclass(frozen=True, eq=False)
class MapElimination:
    """Data to step the map's landmarks when the other states' steps are known."""

    columns: I64  # (N,) of the dense system that the landmarks touch
    square: F64  # (A, 3, 3)
    coupling: F64  # (A, 3, N)
    gradient: F64  # (A, 3)

    def step(self, p_G: F64, step: F64) -> tuple[F64, float]:
        """Return the landmarks (A, 3) after a step (n,) of all else, and the decrease it promises."""
        right = self.gradient + self.coupling @ step[self.columns]
        moved = -np.linalg.solve(self.square, right[:, :, None])[:, :, 0]
        return p_G + moved, -0.5 * float(np.vdot(self.gradient, moved))


class MapTerms:
    """All residuals that a window localised in a map has beyond those of its odometry."""

    def __init__(
        self,
        observations: MapObservations,
        cameras: tuple[Camera, ...],
        T_I_C: F64,
        *,
        huber_sigmas: float,
        tilt_sigma_rad: float = np.inf,
    ) -> None:
        """Join the observations.

        Args:
            observations: Observations of the map's landmarks.
            cameras: As the observations count them.
            T_I_C: Their poses (C, 7) on the IMU.
            huber_sigmas: Scale of the Huber loss.
            tilt_sigma_rad: How level the frames G and M are to each other; infinite = not stated.
        """
        self.observations = observations
        self._data = window_arguments.MapData(
            observations.frame, observations.camera, observations.landmark,
            np.ascontiguousarray(observations.uv_px), 1.0 / observations.sigma_px,
        )  # fmt: skip
        table = Cameras.of(cameras, T_I_C)
        limits = np.array([visibility_limits(camera) for camera in cameras]).reshape(-1, 4)
        self._cameras = window_arguments.MapCameras(table.T_I_C, table.parameters, limits)
        self._huber2, self._tilt_weight = huber_sigmas**2, 1.0 / tilt_sigma_rad
        self._latest: tuple[WindowStates, MapResiduals] | None = None
        self.estimates_landmarks = observations.information_G is not None and len(observations) > 0

    def evaluate(self, T_M_I: F64, T_G_M: F64, p_G: F64) -> MapResiduals:
        """Evaluate all observations.

        Args:
            T_M_I: Poses (F, 7) of the frames.
            T_G_M: Base frame (7,).
            p_G: Landmarks (A, 3).
        """
        count = len(self.observations)
        residual, jacobian = np.empty((count, 2)), np.empty((count, 2, 15))
        visible: Mask = np.zeros(count, dtype=np.bool_)
        window_kernels().reproject_map(
            self._data, self._cameras, T_M_I, T_G_M[None], p_G, residual, jacobian, visible
        )
        return MapResiduals(residual, jacobian, visible)

    def errors_px(self, states: WindowStates) -> F64:
        """Return the reprojection error (O,) of every observation; infinite where it is not visible."""
        at = self._evaluated(states)
        error = np.linalg.norm(at.residual, axis=1) * self.observations.sigma_px
        return np.where(at.is_visible, error, np.inf)

    def costs(self, states: WindowStates) -> dict[str, float]:
        """Return half the sum of rho of every kind at some states."""
        at = self._evaluated(states)
        rho, _ = self._weighed(at)
        tilt, _ = self._tilt(states.T_G_M[0])
        return self._costs(rho, tilt, states)

    def add_to(
        self, system: window_arguments.DenseSystem, states: WindowStates, at: WindowStates
    ) -> tuple[MapElimination | None, dict[str, float]]:
        """Add the normal equations, landmarks eliminated; return how to step these, and the costs.

        Residuals are those at `states`, Jacobians those at `at`.
        """
        now = self._evaluated(states)
        where = now
        if at is not states:
            where = self.evaluate(at.T_M_I, at.T_G_M[0], self._landmarks(states))
        rho, root = self._weighed(now)
        root = np.where(where.is_visible, root, 0.0)
        square, gradient = self._summed(where, now.residual, root, len(states))
        tilt, of_tilt = self._tilt(at.T_G_M[0])
        if at is not states:
            tilt, _ = self._tilt(states.T_G_M[0])
        square[-3:, -3:] += of_tilt.T @ of_tilt
        gradient[-3:] += of_tilt.T @ tilt
        columns = _columns(len(states), len(states.calibration))
        system.gradient[columns] += gradient
        system.diagonal[columns] += np.diagonal(square)
        kept = None
        if self.estimates_landmarks:
            kept = self._eliminated(where, now.residual, root, states)
            Y, z = _half_solved(kept)
            square -= Y.T @ Y
            system.reduced_gradient[columns] -= Y.T @ z
        kernels.add_square(square, columns, system.matrix)
        return kept, self._costs(rho, tilt, states)

    def of_base_frame(self, states: WindowStates) -> tuple[F64, F64, dict[str, float]]:
        """Return the normal equations (6, 6), (6,) of T_G_M while all else is fixed, and the costs."""
        now = self._evaluated(states)
        rho, root = self._weighed(now)
        J = (now.jacobian[..., 6:12] * root[:, None, None]).reshape(-1, 6)
        square, gradient = J.T @ J, J.T @ (now.residual * root[:, None]).reshape(-1)
        tilt, of_tilt = self._tilt(states.T_G_M[0])
        square[3:, 3:] += of_tilt.T @ of_tilt
        gradient[3:] += of_tilt.T @ tilt
        return square, gradient, self._costs(rho, tilt, states)

    def _evaluated(self, states: WindowStates) -> MapResiduals:
        """Evaluate all observations, unless that was done last at the same poses (arrays)."""
        p_G = self._landmarks(states)
        if self._latest is not None:
            before, at = self._latest
            same = before.T_M_I is states.T_M_I and before.T_G_M is states.T_G_M
            if same and self._landmarks(before) is p_G:
                return at
        at = self.evaluate(states.T_M_I, states.T_G_M[0], p_G)
        self._latest = states, at
        return at

    def _summed(self, at: MapResiduals, residual: F64, root: F64, frames: int) -> tuple[F64, F64]:
        """Return the lower triangle of the normal equations (N, N), and their gradient (N,)."""
        size = 6 * frames + 6
        square, gradient = np.zeros((size, size)), np.zeros(size)
        frame = self.observations.frame
        kernels.sum_observations(frame, residual, at.jacobian, root, square, gradient)
        return square, gradient

    def _landmarks(self, states: WindowStates) -> F64:
        return states.p_G if self.estimates_landmarks else self.observations.p_G

    def _weighed(self, at: MapResiduals) -> tuple[F64, F64]:
        """Return rho (O,) and the square root of the robust weight (O,), zero where not visible."""
        rho, root = np.empty(len(at.residual)), np.empty(len(at.residual))
        kernels.weigh(int(Loss.HUBER), at.residual, at.is_visible, self._huber2, _BEHIND, rho, root)
        return rho, root

    def _tilt(self, T_G_M: F64) -> tuple[F64, F64]:
        """Return the whitened tilt of M against G (2,), and its Jacobian (2, 3) by the orientation.

        The upward axis of G, given in M, is the last row u of R_G_M; u exp(d) = u + u x d.
        """
        up_M = so3.to_matrix(T_G_M[:4])[2]
        return self._tilt_weight * up_M[:2], self._tilt_weight * so3.skew(up_M)[:2]

    def _offset(self, p_G: F64) -> F64:
        return p_G - self.observations.p_G

    def _costs(self, rho: F64, tilt: F64, states: WindowStates) -> dict[str, float]:
        costs = {"map": 0.5 * float(rho.sum()), "map tilt": 0.5 * float(tilt @ tilt)}
        information = self.observations.information_G
        if self.estimates_landmarks and information is not None:
            offset = self._offset(states.p_G)
            costs["map landmarks"] = 0.5 * float(
                np.einsum("ai,aij,aj", offset, information, offset)
            )
        return costs

    def _eliminated(
        self, at: MapResiduals, residual: F64, root: F64, states: WindowStates
    ) -> MapElimination:
        """Return the normal equations of the landmarks, at least one."""
        J, r = at.jacobian[..., :12] * root[:, None, None], residual * root[:, None]
        Q = at.jacobian[..., 12:] * root[:, None, None]
        seen, frames = self.observations, len(states)
        assert seen.information_G is not None
        first, turned = seen.start[:-1], Q.transpose(0, 2, 1)
        square = np.add.reduceat(turned @ Q, first) + seen.information_G
        gradient = np.add.reduceat((turned @ r[:, :, None])[:, :, 0], first)
        gradient += (seen.information_G @ self._offset(states.p_G)[:, :, None])[:, :, 0]
        products = turned @ J
        by_frame = np.zeros((len(first) * frames, 3, 6))
        np.add.at(by_frame, seen.landmark * frames + seen.frame, products[:, :, :6])
        of_frames = by_frame.reshape(-1, frames, 3, 6).transpose(0, 2, 1, 3)
        coupling = np.concatenate(
            [
                of_frames.reshape(len(first), 3, 6 * frames),
                np.add.reduceat(products[:, :, 6:], first),
            ],
            axis=2,
        )
        columns = _columns(frames, len(states.calibration))
        return MapElimination(columns, square, coupling, gradient)


def _columns(frames: int, calibration: int) -> I64:
    """Return the columns (6 F + 6,) of the poses of all frames and of the base frame.

    Between them are those of the calibration, which observations of a map take for known.
    """
    of_frames = window_arguments.FRAME_SIZE * np.arange(frames)[:, None] + np.arange(6)
    of_base = window_arguments.FRAME_SIZE * frames + calibration + np.arange(6)
    return np.concatenate([of_frames.reshape(-1), of_base])


def _half_solved(kept: MapElimination) -> tuple[F64, F64]:
    """Return L^-1 W (3 A, N) and L^-1 g (3 A,) with the landmarks' squares L L^T."""
    L = np.linalg.cholesky(kept.square)
    both = np.concatenate([kept.coupling, kept.gradient[:, :, None]], axis=2)
    solved = np.linalg.solve(L, both)
    return solved[:, :, :-1].reshape(-1, solved.shape[2] - 1), solved[:, :, -1].reshape(-1)


# Test of associations with a map against the observations of their tracks.
#
# A track may leave its point for another one, before or after it was matched with a landmark of the map:
# then a single observation can be off by hundreds of pixels. The Huber loss bounds the residual of such
# an observation, but not its Jacobian, which grows without bound near the plane of the camera.

MAP_GATE_CHI2 = 13.8
"""Largest squared error of an observation of the map in standard deviations (99.9 %).

It is wider than the odometry's gate: an observation that is refused takes the association of a whole track
with it, and landmarks of the map have errors of their own.
"""


def contradicted(error_px: F64, seen: MapObservations, options: WindowOptions) -> Mask:
    """Return which landmarks (A,) have an observation far from where it is expected.

    Args:
        error_px: Reprojection errors (O,) at predicted poses; infinite where a landmark is not visible.
        seen: The observations.
        options: Uncertainty of a predicted place, as for landmarks of the odometry.
    """
    if not len(seen):
        return np.zeros(len(seen.start) - 1, dtype=np.bool_)
    sigma2 = seen.sigma_px**2 + options.prediction_sigma_px**2
    far = ~(error_px**2 <= MAP_GATE_CHI2 * sigma2)
    return np.asarray(np.logical_or.reduceat(far, seen.start[:-1]))


def contradicted_unless_most(
    error_px: F64, seen: MapObservations, options: WindowOptions, *, frame: int | None = None
) -> Mask:
    """Return `contradicted`, or none where most landmarks are, since then the prediction is wrong.

    Args:
        error_px: Reprojection errors (O,), see `contradicted`.
        seen: The observations.
        options: Uncertainty of a predicted place.
        frame: The only frame whose observations count; None = all count.
    """
    counts: Mask = np.ones(len(seen), dtype=np.bool_) if frame is None else seen.frame == frame
    result = contradicted(np.where(counts, error_px, 0.0), seen, options)
    if 2 * np.count_nonzero(result) < len(np.unique(seen.landmark[counts])):
        return result
    return np.zeros_like(result)
