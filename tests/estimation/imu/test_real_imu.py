"""A recorded IMU against motion capture: predictions over one second, from true states."""

from __future__ import annotations

import numpy as np

from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.imu.propagation import propagate
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Imu
from tests.estimation.imu.motion import GRAVITY
from tests.support.data import shared_data


def test_one_second_predictions_of_euroc_meet_motion_capture():
    folder = shared_data("euroc_imu")
    imu = np.loadtxt(folder / "V101.imu.csv", delimiter=",", dtype=np.float64)
    imu_ns = np.loadtxt(
        folder / "V101.imu.csv",
        delimiter=",",
        dtype=np.int64,
        usecols=0,
        converters=int,
    )
    truth = np.loadtxt(folder / "V101.gt.csv", delimiter=",")
    truth_ns = np.loadtxt(
        folder / "V101.gt.csv",
        delimiter=",",
        dtype=np.int64,
        usecols=0,
        converters=int,
    )
    T = se3.make(truth[:, [5, 6, 7, 4]], truth[:, 1:4])
    every = 20  # one second at 20 Hz
    begin = np.arange(0, len(truth) - every, every)
    first = np.searchsorted(imu_ns, truth_ns[begin])
    last = np.searchsorted(imu_ns, truth_ns[begin + every])
    fits = (imu_ns[first] == truth_ns[begin]) & (imu_ns[last] == truth_ns[begin + every])
    begin, first, last = begin[fits], first[fits], last[fits]
    assert len(begin) > 100
    rows = np.concatenate([np.arange(a, b + 1) for a, b in zip(first, last, strict=True)])
    start = np.concatenate([[0], np.cumsum(last - first + 1)])
    samples = imu[rows][:, [4, 5, 6, 1, 2, 3]]
    data = InertialData(start, imu_ns[rows], samples, (Imu("0" * 32),), np.zeros(len(begin), int))
    T_end, v_end = propagate(
        data, T[begin], truth[begin, 8:11], truth[begin, 11:14], truth[begin, 14:17], GRAVITY
    )
    at_end = start[1:] - 1
    q_error = so3.multiply(so3.inverse(T[begin + every, :4]), T_end[at_end, :4])
    angle = np.rad2deg(np.linalg.norm(so3.log(q_error), axis=1))
    position = np.linalg.norm(T_end[at_end, 4:] - T[begin + every, 4:], axis=1)
    velocity = np.linalg.norm(v_end[at_end] - truth[begin + every, 8:11], axis=1)
    assert np.median(angle) < 0.15  # the attitude of motion capture itself is good to about 0.1 deg
    assert np.median(position) < 0.03
    assert np.median(velocity) < 0.05
