"""The inertial edges between neighbouring frames of a window, as a chain that grows and shrinks."""

import dataclasses
from types import ModuleType

import numpy as np

from maplab_py.array_types import F64, I64, Mask
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.kernels import imu as kernels
from maplab_py.estimation.terms.inertial import FLOOR, outdated_edges
from maplab_py.estimation.window.frame import NO_PART, ImuPart
from maplab_py.geometry import se3, so3, symmetric
from maplab_py.sensors import Imu
from maplab_py.vimap.table import starts_of_counts

_SHORTEST_WALK_S = 1e-9
_INPUTS, _MEASURED, _DURATION = 100, 74, 70
"""Inputs of the inertial residual, how many of them do not depend on states, and the duration's place."""


_COLUMNS = (
    "_arguments", "_whitening", "_integrated_at", "_seen_at",
    "duration_s", "is_resting", "is_open", "_is_stale", "_failed",
)  # fmt: skip
_FAILED_RATE, _FAILED_ACCELERATION = 0.2, 1.0
"""Noise densities [rad/s/sqrt(Hz)], [m/s^2/sqrt(Hz)] of sensors that have failed: 0.9 rad/s and 4.5 m/s^2 in
50 ms, as a hand's motion changes. Biases walk as far in a second, for they may have changed."""
_FAILED_WALK = (0.2, 1.0)

Samples = list[tuple[I64, F64]]
"""Times (S,) [ns] and values (S, 6) of the samples of each of some edges."""


class InertialChain:
    """Edges e = 0 .. E - 1 from frame e to frame e + 1 with all their samples.

    An open edge has no information: the prior has it.
    """

    def __init__(self, kernel: ModuleType, imu: Imu) -> None:
        """Begin without edges; the kernel is that of the residual `inertial`."""
        self._kernel = kernel
        self.take_imu(imu)
        self._samples: Samples = []
        self._arguments, self._whitening = np.zeros((0, _MEASURED)), np.zeros((0, 9, 9))
        self._integrated_at, self._seen_at = np.zeros((0, 6)), np.zeros((0, 6))
        self._latest: tuple[F64, F64, tuple[F64, F64]] | None = None
        """Poses and motion at which all edges were evaluated last, and the result: an accepted step is tried,
        then linearised at."""
        self.duration_s = np.zeros(0)
        self.is_resting: Mask = np.zeros(0, dtype=np.bool_)
        self.is_open: Mask = np.zeros(0, dtype=np.bool_)
        self._is_stale: Mask = np.zeros(0, dtype=np.bool_)
        self._failed: I64 = np.zeros(0, dtype=np.int64)  # `ImuPart` of every edge

    def take_imu(self, imu: Imu) -> None:
        """Interpret samples as those of an IMU, without integrating edges again."""
        imus = tuple(_with_failed(imu, ImuPart(parts)) for parts in range(4))
        self._imus = InertialData(
            np.zeros(1, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros((0, 6)), imus,
            np.zeros(0, dtype=np.int64),
        )  # fmt: skip
        self._walk_density = np.sqrt(self._imus.walk_variance_density)
        self._g_M = np.array([0.0, 0.0, -imu.gravity_magnitude_mps2])

    @property
    def corrections(self) -> F64:
        """Matrices (2, 3, 3) that correct scale and misalignment of gyroscope and accelerometer."""
        return np.stack([of_kind[0] for of_kind in self._imus.corrections])

    def mean_samples(self) -> F64:
        """Return the mean (2, 3) of the samples of gyroscope and accelerometer; zeros without edges."""
        samples = [values for _, values in self._samples] or [np.zeros((1, 6))]
        return np.asarray(np.concatenate(samples).mean(axis=0).reshape(2, 3)[::-1])

    def integrate_again(self, motion: F64) -> None:
        """Integrate all edges with the present IMU and the biases in the motion (F, 9) of the frames."""
        self._integrated_at, self._is_stale = motion[: len(self), 3:].copy(), ~self.is_open
        self._integrate_stale()

    def __len__(self) -> int:
        return len(self._samples)

    @property
    def walk_weight(self) -> F64:
        """Inverse standard deviations (E, 2) of the walk of a bias' component, gyroscope first."""
        root_s = np.sqrt(np.maximum(self.duration_s, _SHORTEST_WALK_S))
        weight = 1.0 / np.maximum(root_s[:, None] * self._walk_density[self._failed], 1e-9)
        return np.where(self.is_open[:, None], 0.0, weight)

    def append(
        self, times_ns: I64, accel_gyro: F64, motion: F64, *, is_resting: bool,
        failed: ImuPart = NO_PART,
    ) -> None:  # fmt: skip
        """Add the edge to a new frame; its biases are those in the motion (9,) of the last one.

        Raises:
            MapError: Times run backwards, or a sample is not a number.
        """
        self.extend([(times_ns, accel_gyro)], motion[None], is_resting=is_resting, failed=failed)

    def doubt(self, since_ns: int, failed: ImuPart) -> None:
        """Take parts of the IMU as failed in all edges that end after a time."""
        for row, (times_ns, _) in enumerate(self._samples):
            if int(times_ns[-1]) > since_ns and not self.is_open[row]:
                self._failed[row] |= failed
                self._is_stale[row] = True

    def extend(
        self, samples: Samples, motion: F64, *, is_resting: bool = False,
        failed: ImuPart = NO_PART,
    ) -> None:  # fmt: skip
        """Add N edges to new frames; their biases are those in the motion (N, 9) where they begin.

        Raises:
            MapError: Times run backwards, or a sample is not a number.
        """
        count, biases = len(samples), motion[:, 3:]
        samples = [_checked(*each) for each in samples]
        new = (
            np.zeros((count, _MEASURED)), np.zeros((count, 9, 9)), biases, biases,
            np.zeros(count), np.full(count, is_resting), np.zeros(count, dtype=np.bool_),
            np.ones(count, dtype=np.bool_), np.full(count, int(failed)),
        )  # fmt: skip
        self._samples += samples
        for name, values in zip(_COLUMNS, new, strict=True):
            setattr(self, name, np.concatenate([getattr(self, name), values]))
        self._integrate_stale()

    def predict(self, T_M_I: F64, motion: F64) -> tuple[F64, F64]:
        """Return pose (7,) and motion (9,) at the end of the last edge, from those at its start."""
        values = self._arguments[-1]
        q_A_B, dp, dv, dt = values[:4], values[4:7], values[7:10], self.duration_s[-1]
        R_M_A = so3.to_matrix(T_M_I[:4])
        p_M_B = T_M_I[4:] + R_M_A @ dp + motion[:3] * dt + 0.5 * self._g_M * dt * dt
        T_M_B = se3.make(so3.normalize(so3.multiply(T_M_I[:4], q_A_B)), p_M_B)
        v_M = motion[:3] + R_M_A @ dv + self._g_M * dt
        return T_M_B, np.concatenate([v_M, motion[3:]])

    def drop_first(self) -> None:
        """Remove the edge from the first frame."""
        self._drop(0)

    def join(self, frame: int, motion: F64) -> None:
        """Remove a frame inside: make a single edge of those that meet in it.

        Args:
            frame: Row of the frame.
            motion: (9,) of the frame before, with its biases.
        """
        first, second = self._samples[frame - 1], self._samples[frame]
        times_ns = np.concatenate([first[0], second[0][1:]])
        accel_gyro = np.concatenate([first[1], second[1][1:]])
        self._samples[frame - 1] = times_ns, accel_gyro
        self._integrated_at[frame - 1], self._is_stale[frame - 1] = motion[3:], True
        self.is_resting[frame - 1] &= self.is_resting[frame]
        self._failed[frame - 1] |= self._failed[frame]
        self.duration_s[frame - 1] += self.duration_s[frame]
        self._drop(frame)

    def joined_s(self, frame: int) -> float:
        """Return how long the edge without a frame inside would be [s]; infinite when not known."""
        if self.is_open[frame - 1] or self.is_open[frame]:
            return np.inf
        return float(self.duration_s[frame - 1] + self.duration_s[frame])

    def open(self, frame: int) -> None:
        """Remove a frame inside: the edges that meet in it become an open one."""
        self._whitening[frame - 1] = 0.0
        self.duration_s[frame - 1] = 0.0
        self.is_resting[frame - 1], self.is_open[frame - 1] = False, True
        self._is_stale[frame - 1] = False
        self._drop(frame)

    def drop_last(self) -> None:
        """Remove the edge to the last frame."""
        self._drop(len(self) - 1)

    def last_samples(self) -> tuple[I64, F64]:
        """Return times (S,) and samples (S, 6) of the last edge."""
        return self._samples[-1]

    def relinearize(self, motion: F64) -> bool:
        """Integrate edges again whose biases (in F, 9) have changed much; return whether there are any."""
        self._integrate_stale()
        biases = motion[: len(self), 3:].copy()
        outdated = outdated_edges(biases, self._integrated_at, self._seen_at, self.duration_s)
        self._seen_at = biases
        self._integrate(outdated, biases[outdated])
        return len(outdated) > 0

    def evaluate(self, T_M_I: F64, motion: F64, edges: slice) -> tuple[F64, F64]:
        """Return whitened residuals (N, 9) and Jacobians (N, 9, 24) of some edges.

        The columns are the 15 rows of the first frame and the first 9 of the second.
        """
        self._integrate_stale()
        is_whole = edges == slice(None)
        if is_whole and self._latest and self._latest[0] is T_M_I and self._latest[1] is motion:
            return self._latest[2]
        count = len(range(len(self))[edges])
        arguments = np.empty((count, _INPUTS))
        arguments[:, :7], arguments[:, 7:16] = T_M_I[:-1][edges], motion[:-1][edges]
        arguments[:, 16:23], arguments[:, 23:26] = T_M_I[1:][edges], motion[1:, :3][edges]
        arguments[:, 26:] = self._arguments[edges]
        result: tuple[F64, F64] = self._kernel.evaluated(arguments, self._whitening[edges])
        if is_whole:
            self._latest = T_M_I, motion, result
        return result

    def _integrate_stale(self) -> None:
        """Integrate edges whose samples are new or have been joined."""
        if self._is_stale.any():
            rows = np.flatnonzero(self._is_stale)
            self._integrate(rows, self._integrated_at[rows])

    def _integrate(self, rows: I64, biases: F64) -> None:
        if not len(rows):
            return
        self._latest = None
        samples = [self._samples[row] for row in rows.tolist()]
        start = starts_of_counts(np.array([len(times_ns) for times_ns, _ in samples]))
        times_ns, accel_gyro = map(np.concatenate, zip(*samples, strict=True))
        data = kernels.EdgeSamples(
            start, times_ns, accel_gyro, biases[:, :3].copy(), biases[:, 3:].copy(),
            self._failed[rows], *self._imus.corrections,
        )  # fmt: skip
        arguments, covariance = np.empty((len(rows), _MEASURED)), np.empty((len(rows), 9, 9))
        imus = self._imus.internal_rotation, self._imus.noise_variance_density
        kernels.integrate_for_residuals(data, *imus, self._g_M, FLOOR, arguments, covariance)
        self._arguments[rows] = arguments
        self._whitening[rows] = symmetric.lower_whitening(covariance)
        self._integrated_at[rows] = self._seen_at[rows] = biases
        self.duration_s[rows] = arguments[:, _DURATION]
        self._is_stale[rows] = False

    def _drop(self, edge: int) -> None:
        self._latest = None
        del self._samples[edge]
        kept: Mask = np.arange(len(self._is_stale)) != edge
        for name in _COLUMNS:
            setattr(self, name, getattr(self, name)[kept])


def _checked(times_ns: I64, accel_gyro: F64) -> tuple[I64, F64]:
    """Return the samples of an edge as kernels read them.

    Raises:
        MapError: Times run backwards, or a sample is not a number.
    """
    start, imu = np.array([0, len(times_ns)], dtype=np.int64), np.zeros(1, dtype=np.int64)
    times_ns = np.ascontiguousarray(times_ns, dtype=np.int64)
    data = InertialData(start, times_ns, np.ascontiguousarray(accel_gyro, np.float64), (), imu)
    return data.timestamp_ns, data.accel_gyro


def _with_failed(imu: Imu, parts: ImuPart) -> Imu:
    """Return the IMU with the noise of some parts as large as that of a guess."""
    changed: dict[str, float] = {}
    if ImuPart.GYROSCOPE in parts:
        changed["gyro_noise_density"] = _FAILED_RATE
        changed["gyro_bias_random_walk_noise_density"] = _FAILED_WALK[0]
    if ImuPart.ACCELEROMETER in parts:
        changed["acc_noise_density"] = _FAILED_ACCELERATION
        changed["acc_bias_random_walk_noise_density"] = _FAILED_WALK[1]
    return dataclasses.replace(imu, **changed)  # type: ignore[arg-type]
