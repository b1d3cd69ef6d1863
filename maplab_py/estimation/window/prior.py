"""Marginalization prior of the sliding window."""

from __future__ import annotations

import dataclasses
from functools import cached_property

import numpy as np
import scipy.linalg.lapack

from maplab_py.array_types import F64, I64, Mask
from maplab_py.estimation.kernels.window_arguments import FRAME_SIZE
from maplab_py.estimation.window.states import WindowStates
from maplab_py.geometry import so3

_LEAST_PIVOT = 1e-13
"""Pivots of the scaled information below this share of the largest are rounding errors."""


@dataclasses.dataclass(frozen=True, eq=False)
class WindowPrior:
    """The residual root (x - x0) + residual over F frames; x - x0 is the tangent from x0 to x.

    Frames it does not touch have zero columns. The linearisation point x0 of a fixed frame stays what it
    was when a marginalisation first touched it. The columns of the calibration and then of a base frame
    follow those of the frames; that of the calibration moves with it, as it is observable.
    """

    root: F64  # (k, 15 F + K + 6 B)
    residual: F64  # (k,)
    x0: WindowStates  # whose landmarks do not count
    is_fixed: Mask  # (F,)
    is_base_fixed: bool = False

    @classmethod
    def of_state(
        cls,
        T_M_I: F64,
        motion: F64,
        sigma: F64,
        calibration: tuple[F64, F64] = (np.zeros(0), np.zeros(0)),
    ) -> WindowPrior:
        """Return the prior of a first frame with standard deviations (15,), infinite = unknown.

        Args:
            T_M_I: Its pose (7,).
            motion: Its motion (9,).
            sigma: The deviations.
            calibration: Mean (K,) and standard deviations (K,) of the calibration.
        """
        mean, of_calibration = calibration
        sigma = np.concatenate([sigma, of_calibration])
        known = np.flatnonzero(np.isfinite(sigma))
        root = np.zeros((len(known), len(sigma)))
        root[np.arange(len(known)), known] = 1.0 / sigma[known]
        x0 = WindowStates(T_M_I[None], motion[None], np.zeros((0, 3)), calibration=mean)
        return cls(root, np.zeros(len(known)), x0, np.zeros(1, dtype=np.bool_))

    @classmethod
    def of_information(
        cls, information: F64, gradient: F64, x0: WindowStates, is_fixed: Mask
    ) -> WindowPrior:
        """Return the root form of normal equations (n, n), (n,) at x0.

        The information may be singular: the root comes from Cholesky with pivoting, of the matrix
        scaled to a unit diagonal, and has as many rows as there are directions with information.
        """
        count = len(information)
        rows = np.flatnonzero(np.diagonal(information) > 0.0)
        scale = np.sqrt(np.diagonal(information)[rows])
        scaled = information[np.ix_(rows, rows)] / (scale[:, None] * scale[None, :])
        upper, pivot, rank, _ = scipy.linalg.lapack.dpstrf(scaled, tol=_LEAST_PIVOT, lower=0)
        factor = np.triu(upper)[:rank]
        root, order = np.zeros((rank, count)), pivot - 1
        root[:, rows[order]] = factor * scale[order]
        right = (gradient[rows] / scale)[order][:rank]
        residual, _ = scipy.linalg.lapack.dtrtrs(factor[:, :rank], right, lower=0, trans=1)
        return cls(root, residual, x0, is_fixed)

    @cached_property
    def information(self) -> F64:
        """root^T root, n x n with n = 15 F + K + 6 B."""
        return self.root.T @ self.root

    @cached_property
    def touched(self) -> Mask:
        """Frames (F,) that it has information about."""
        columns: Mask = np.any(self.root[:, : self._frame_columns] != 0.0, axis=0)
        return np.asarray(columns.reshape(-1, FRAME_SIZE).any(axis=1))

    @cached_property
    def touches_base(self) -> bool:
        """Whether it has information about the base frame."""
        return bool(np.any(self.root[:, self._base_columns :]))

    @property
    def _frame_columns(self) -> int:
        return FRAME_SIZE * len(self.x0)

    @property
    def _base_columns(self) -> int:
        return self._frame_columns + len(self.x0.calibration)

    @cached_property
    def _free(self) -> I64:
        """First column of the orientation of all that it touches and that is not fixed."""
        columns = FRAME_SIZE * np.flatnonzero(self.touched & ~self.is_fixed) + 3
        if self.touches_base and not self.is_base_fixed:
            columns = np.append(columns, self._base_columns + 3)
        return columns

    def linearization_point(self, states: WindowStates) -> WindowStates:
        """Return the states at x0 where that is fixed, as they are elsewhere."""
        T_M_I, motion = states.T_M_I.copy(), states.motion.copy()
        fixed = self.is_fixed
        T_M_I[fixed], motion[fixed] = self.x0.T_M_I[fixed], self.x0.motion[fixed]
        T_G_M = self.x0.T_G_M if self.is_base_fixed else states.T_G_M
        return dataclasses.replace(states, T_M_I=T_M_I, motion=motion, T_G_M=T_G_M)

    def evaluate(self, states: WindowStates) -> F64:
        """Return the residual (k,) at some states."""
        return np.asarray(self.root @ states.offsets(self.x0) + self.residual)

    def linearized(self, states: WindowStates) -> tuple[F64, F64, F64]:
        """Return residual (k,), its Jacobian's square (n, n), and gradient (n,), n = 15 F + K + 6 B.

        The Jacobian of a fixed frame is that at x0; of the others the exact one, which differs by
        the right Jacobian of the rotation from x0.
        """
        offset = states.offsets(self.x0)
        residual = np.asarray(self.root @ offset + self.residual)
        free = self._free
        if not len(free):
            return residual, self.information, self.root.T @ residual
        root = self.root.copy()
        columns = free[:, None] + np.arange(3)
        slope = so3.right_jacobian_inverse(offset[columns])
        root[:, columns] = np.einsum("kfi,fij->kfj", root[:, columns], slope)
        return residual, root.T @ root, root.T @ residual

    def with_frame(self, T_M_I: F64, motion: F64) -> WindowPrior:
        """Return the prior with a later frame that it does not touch."""
        padding = np.zeros((len(self.root), FRAME_SIZE))
        frames, base = np.split(self.root, [self._frame_columns], axis=1)
        return dataclasses.replace(
            self,
            root=np.concatenate([frames, padding, base], axis=1),
            x0=self.x0.with_frame(T_M_I, motion),
            is_fixed=np.append(self.is_fixed, False),
        )

    def with_base(self, T_G_M: F64, sigma: F64) -> WindowPrior:
        """Return the prior with a base frame (7,) in place of another; sigma (6,) of [p, theta]."""
        prior = self.without_base()
        rows, columns = prior.root.shape
        root = np.zeros((rows + 6, columns + 6))
        root[:rows, :columns] = prior.root
        root[rows:, columns:] = np.diag(1.0 / sigma)
        residual = np.concatenate([prior.residual, np.zeros(6)])
        x0 = dataclasses.replace(prior.x0, T_G_M=T_G_M[None])
        return dataclasses.replace(prior, root=root, residual=residual, x0=x0, is_base_fixed=False)

    def without_base(self) -> WindowPrior:
        """Return the prior of the frames, with the base frame marginalised."""
        if not len(self.x0.T_G_M):
            return self
        x0 = dataclasses.replace(self.x0, T_G_M=np.zeros((0, 7)))
        return self._without(self._base_columns + np.arange(6), x0, self.is_fixed)

    def without_frame(self, frame: int) -> WindowPrior:
        """Return the prior of all other frames, with this frame marginalised."""
        columns = FRAME_SIZE * frame + np.arange(FRAME_SIZE)
        is_fixed = np.delete(self.is_fixed, frame)
        return self._without(columns, self.x0.without_frame(frame), is_fixed)

    def _without(self, columns: I64, x0: WindowStates, is_fixed: Mask) -> WindowPrior:
        """Return the prior with some columns marginalised; x0 is that of the others."""
        is_base_fixed = self.is_base_fixed and len(x0.T_G_M) > 0
        if not self.root[:, columns].any():
            root = np.delete(self.root, columns, axis=1)
            result = dataclasses.replace(self, root=root, x0=x0, is_fixed=is_fixed)
        else:
            information, gradient = schur_complement(
                self.information, self.root.T @ self.residual, columns
            )
            result = WindowPrior.of_information(information, gradient, x0, is_fixed)
        return dataclasses.replace(result, is_base_fixed=is_base_fixed)


def schur_complement(information: F64, gradient: F64, rows: I64) -> tuple[F64, F64]:
    """Marginalise some rows (m,) of normal equations (n, n), (n,); return those of the others.

    Directions of the rows without information are left out (pseudo-inverse of the block, scaled
    to a unit diagonal). Source: Sibley, Matthies and Sukhatme, Sliding Window Filter with Application to
    Planetary Landing, JFR 2010, eq. (31)-(36).
    """
    is_other: Mask = np.ones(len(information), dtype=np.bool_)
    is_other[rows] = False
    others = np.flatnonzero(is_other)
    block = information[np.ix_(rows, rows)]
    diagonal = np.diagonal(block)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(scale[:, None] * block * scale[None, :])
    kept = values > _LEAST_PIVOT * values[-1]
    half = (vectors[:, kept] / np.sqrt(values[kept])).T * scale
    coupling = half @ information[np.ix_(rows, others)]
    reduced = information[np.ix_(others, others)] - coupling.T @ coupling
    return 0.5 * (reduced + reduced.T), gradient[others] - coupling.T @ (half @ gradient[rows])
