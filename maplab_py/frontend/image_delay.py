"""The delay of the images on the clock of the IMU, as it shows while a recording is read."""

import numpy as np

from maplab_py.estimation.linear.threads import single_thread
from maplab_py.estimation.window.frame import ImuPart, WindowFrame
from maplab_py.frontend.initialization import gyro_bias, rays
from maplab_py.frontend.initialization.segment import History
from maplab_py.interop.recordings.protocol import RecordedSensors

_SPAN_S, _INTERVAL_S = 1.5, 0.1
"""Length of a segment from which the delay is measured, and between its frames."""
_MIN_PAIRS = 6
_PRIOR_SIGMA_S = 0.05
_LEAST_SIGMA_S = 2e-4
_WALK_S = 1e-4
"""Random walk of the delay in a second."""
_GATE_SIGMAS, _SIGNIFICANT_SIGMAS = 3.0, 3.0
_FIRST_CHANGE_S, _CHANGE_S = 1.5e-3, 0.5e-3
"""Smallest changes that are applied: at first, where calibrations are right, and later."""
_LARGEST_S = 0.15


class DelayMonitor:
    """Measures the delay segment by segment, and filters it (a Kalman filter of one state).

    `applied_s` is by how much later than their stamps say images count, `known_s` that of the calibration.
    """

    def __init__(self, device: RecordedSensors) -> None:
        self.recalibrate(device)
        self._mean_s, self._variance = 0.0, _PRIOR_SIGMA_S**2
        self.applied_s = 0.0

    def recalibrate(self, device: RecordedSensors) -> None:
        """Forget the frames, and measure with another calibration from now on."""
        assert device.imu is not None
        self._imu = device.imu
        self._rays = rays.RayMaker(device.cameras, device.T_I_C)
        middle_s = [c.delay_s(np.array([[0.0, 0.5 * c.height_px]])) for c in device.cameras]
        self.known_s = float(np.mean(middle_s))
        self.reset()

    @property
    def unknown_s(self) -> float:
        """Applied delay of the middle rows without what of it is in the calibration."""
        return self.applied_s - self.known_s if self.applied_s else 0.0

    @property
    def delay_s(self) -> float:
        """Estimate of the delay."""
        return self._mean_s

    @property
    def sigma_s(self) -> float:
        """Standard deviation of it."""
        return float(np.sqrt(self._variance))

    def reset(self) -> None:
        """Forget the frames, and keep what they have said."""
        self._history = History(_SPAN_S + 1e-3)

    def push(self, frame: WindowFrame) -> bool:
        """Take a frame whose time has the delay applied; return whether another is to be applied."""
        if ImuPart.GYROSCOPE in frame.failed:  # its turns follow from the frame before
            self.reset()
            return False
        self._history.push(frame)
        if self._history.duration_s < _SPAN_S - 5e-3:
            return False
        with single_thread():
            segment = self._history.segment(self._imu, _INTERVAL_S)
            pairs = gyro_bias.ray_pairs(self._rays.of(segment))
            self.reset()
            if len(pairs.first_frame) < _MIN_PAIRS:
                return False
            fit = gyro_bias.fit_turns(segment.inertial, pairs)
        self._add(self.applied_s + fit.delay_s, max(fit.delay_sigma_s, _LEAST_SIGMA_S))
        change_s = self._mean_s - self.applied_s
        least_s = _CHANGE_S if self.applied_s else _FIRST_CHANGE_S
        if abs(change_s) < max(least_s, _SIGNIFICANT_SIGMAS * self.sigma_s):
            return False
        self.applied_s = self._mean_s
        return True

    def _add(self, measured_s: float, sigma_s: float) -> None:
        """Take a measurement; one far off says that the deviations are larger than computed."""
        if abs(measured_s) > _LARGEST_S:
            return
        self._variance += _WALK_S**2 * _SPAN_S
        off = measured_s - self._mean_s
        variance = max(sigma_s**2, (off / _GATE_SIGMAS) ** 2 - self._variance)
        gain = self._variance / (self._variance + variance)
        self._mean_s += gain * off
        self._variance *= 1.0 - gain
