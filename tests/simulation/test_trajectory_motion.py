"""Splines through recorded trajectories: they meet every pose, and feel like the recorded IMU."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3
from maplab_py.interop.imu_csv import read_imu_csv
from maplab_py.interop.trajectories import Trajectory, read_trajectory, write_euroc, write_tum
from maplab_py.simulation.scenario import SessionOptions, WorldOptions
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from maplab_py.simulation.trajectory_motion import through, trajectory_spline
from tests.support.data import shared_data

HALL = WorldOptions(room_size_m=(20.0, 20.0, 8.0))


def _poses(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    q = so3.exp(np.cumsum(rng.normal(0.0, 0.15, (count, 3)), axis=0))
    return se3.make(q, np.cumsum(rng.normal(0.0, 0.1, (count, 3)), axis=0))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_spline_passes_through_every_pose(seed: int) -> None:
    poses = _poses(40, seed)
    spline = through(poses, 0.1)
    met = spline.evaluate(np.arange(40) * 0.1).T_G_I
    np.testing.assert_allclose(se3.local(met, poses), 0.0, atol=1e-8)
    assert spline.duration_s >= 3.9


@pytest.mark.parametrize("write", [write_tum, write_euroc])
def test_files_of_both_kinds_give_the_same_motion(tmp_path: Path, write: object) -> None:
    poses = _poses(60)
    times = 1_500_000_000_000_000_000 + np.arange(60) * 100_000_000
    write(Trajectory(times, poses), tmp_path / "t.csv")  # type: ignore[operator]
    options = SessionOptions(trajectory=str(tmp_path / "t.csv"), duration_s=5.0, height_m=2.0)
    spline = trajectory_spline(options, HALL)
    found = spline.evaluate(np.arange(50) * 0.1).T_G_I
    relative = se3.relative(found[:-1], found[1:])
    np.testing.assert_allclose(relative, se3.relative(poses[:49], poses[1:50]), atol=1e-7)
    assert found[0, 6] == pytest.approx(2.0)


def test_a_scenario_finds_its_trajectory_beside_it(tmp_path: Path) -> None:
    count = 80
    angle = np.linspace(0.0, 1.0, count)
    p = np.stack([2.0 * np.cos(angle), 2.0 * np.sin(angle), 0.0 * angle], axis=1)
    q = so3.exp(np.stack([0.0 * angle, 0.0 * angle, angle], axis=1))
    write_tum(Trajectory(np.arange(count) * 100_000_000, se3.make(q, p)), tmp_path / "walk.txt")
    (tmp_path / "mine.yaml").write_text(
        "world: {landmarks_per_room: 600}\nmeasurement: {frame_rate_hz: 4}\n"
        "sessions: [{trajectory: walk.txt, duration_s: 6}]\n"
    )
    data = simulate(load_scenario(tmp_path / "mine.yaml"))
    assert len(data.maps[0].vertices) == 25
    assert np.ptp(data.truth.T_G_I[:, 5]) == pytest.approx(2.0 * np.sin(0.76), abs=0.1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nonsense", "sessions.trajectory: "),
        ("0 0 0 0 0 0 0 1\n0.1 0 0 0 0 0 0 1\n", r"sessions.duration_s: .* lasts 0.1 s"),
        ("".join(f"{t} 0 0 0 0 0 0 1\n" for t in (0, 1, 5, 6, 7)), "gap of more than a second"),
    ],
)
def test_files_that_cannot_be_used(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "t.txt").write_text(text)
    options = SessionOptions(trajectory=str(tmp_path / "t.txt"), duration_s=3.0)
    with pytest.raises(UserError, match=message) as caught:
        trajectory_spline(options, HALL)
    assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match=r"sessions\.trajectory"):
        trajectory_spline(dataclasses.replace(options, trajectory="absent.txt"), HALL)


def test_the_spline_through_euroc_feels_like_its_imu() -> None:
    """A flight's spline, compared with what the IMU recorded during it."""
    path = shared_data("euroc_imu/V101.gt.csv")
    recorded = read_imu_csv(shared_data("euroc_imu/V101.imu.csv"))
    truth = read_trajectory(path)
    spline = trajectory_spline(SessionOptions(trajectory=str(path), duration_s=60.0), HALL)
    time = np.arange(10.0, 55.0, 0.005)
    state = spline.evaluate(time)
    now_ns = truth.times_ns[0] + np.round(time * 1e9).astype(np.int64)
    samples = np.stack(
        [
            np.interp(now_ns - truth.times_ns[0], recorded.times_ns - truth.times_ns[0], column)
            for column in recorded.accel_gyro.T
        ],
        axis=1,
    )
    smooth = np.ones(40) / 40.0

    def low_passed(signal: np.ndarray) -> np.ndarray:
        return np.stack([np.convolve(column, smooth, "valid") for column in signal.T], axis=1)

    # below 5 Hz both see the same motion; what differs is the bias that the file knows too
    gyro = low_passed(samples[:, 3:] - state.w_I)
    assert truth.gyro_bias is not None
    np.testing.assert_allclose(gyro.mean(axis=0), truth.gyro_bias.mean(axis=0), atol=2e-3)
    assert np.std(gyro, axis=0).max() < 0.01
    assert np.std(low_passed(state.w_I), axis=0).max() > 0.1
    force = so3.rotate(so3.inverse(state.T_G_I[:, :4]), state.a_G + np.array([0.0, 0.0, 9.81]))
    accel = low_passed(samples[:, :3] - force)
    assert np.std(accel, axis=0).max() < 0.1
