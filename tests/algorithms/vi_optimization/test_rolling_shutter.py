"""Rolling shutters: known line delays, estimated ones, and the fast kernels that need none."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from maplab_py.algorithms.landmarks.sightings import rays_in_G, residuals
from maplab_py.algorithms.self_calibration.calibration import calibrate
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.vi_optimization import map_problem, optimization
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.sensors import Camera, CameraRig
from maplab_py.simulation import evaluation, truth
from maplab_py.simulation import scenario as sim
from maplab_py.simulation.simulate import SimulatedData, simulate
from maplab_py.storage.native import load_map, save_map
from maplab_py.vimap import VIMap
from tests.support.noiseless import without_noise

LINE_DELAY_S = 30e-3 / 480


def scenario(seed: int, seconds: float, line_delay_s: float = LINE_DELAY_S) -> sim.Scenario:
    """A walk through a room with a camera that reads an image in 30 ms."""
    return dataclasses.replace(
        sim.Scenario().with_seed(seed),
        sessions=(sim.SessionOptions(duration_s=seconds),),
        world=sim.WorldOptions(landmarks_per_room=800),
        measurement=sim.MeasurementOptions(max_keypoints=150),
        cameras=(sim.CameraOptions(line_delay_s=line_delay_s),),
    )


def camera_of(vi_map: VIMap) -> Camera:
    return next(s for s in vi_map.sensors.sensors.values() if isinstance(s, CameraRig)).cameras[0]


def with_timing(vi_map: VIMap, **changes: Any) -> VIMap:
    """Return the map with another image delay or line delay."""
    rig = next(s for s in vi_map.sensors.sensors.values() if isinstance(s, CameraRig))
    cameras = (dataclasses.replace(rig.cameras[0], **changes),)
    sensors = {**vi_map.sensors.sensors, rig.id: dataclasses.replace(rig, cameras=cameras)}
    return vi_map.replace(sensors=dataclasses.replace(vi_map.sensors, sensors=sensors))


@pytest.fixture(scope="module")
def exact() -> SimulatedData:
    return simulate(without_noise(scenario(1, 6.0)))


def test_rows_are_seen_from_where_the_camera_was(exact: SimulatedData) -> None:
    """Triangulation and quality of landmarks take the time of each row into account."""
    vi_map = truth.true_map(exact.maps[0], exact.truth)
    keypoints = vi_map.observations
    p_G = vi_map.p_G[vi_map.keypoints.landmark[keypoints]]
    still = with_timing(vi_map, image_delay_s=0.0, line_delay_ns=0)
    errors_px = [residuals(each, keypoints, p_G).error_px for each in (vi_map, still)]
    assert np.median(errors_px[0]) < 0.05 < 1.0 < np.median(errors_px[1])
    distances_m = []
    for each in (vi_map, still):
        origin, direction, valid = rays_in_G(each, keypoints)
        offset = p_G - origin
        along = np.einsum("ni,ni->n", offset, direction)[:, None] * direction
        distances_m.append(float(np.median(np.linalg.norm(offset - along, axis=1)[valid])))
    assert distances_m[0] < 1e-3
    assert distances_m[1] > 10.0 * distances_m[0]


def test_known_line_delays_need_no_other_kernels(exact: SimulatedData) -> None:
    vi_map = truth.true_map(exact.maps[0], exact.truth)
    options = VIOptimizationOptions(include_inertial=False)
    problem = map_problem.build(vi_map, options)
    visual = problem.problem.visual
    assert visual is not None
    assert not visual.estimates_cameras
    assert visual.refresh(problem.states)
    assert np.median(visual.errors(problem.states)[0]) < 0.05
    still = map_problem.build(with_timing(vi_map, image_delay_s=0.0, line_delay_ns=0), options)
    assert still.problem.visual is not None
    assert not still.problem.visual.refresh(still.states)
    assert np.median(still.problem.visual.errors(still.states)[0]) > 1.0


def test_line_delays_survive_the_files_of_a_map(exact: SimulatedData, tmp_path: Any) -> None:
    before = camera_of(exact.maps[0])
    assert before.line_delay_ns == 62_500
    assert before.image_delay_s == pytest.approx(-0.015)
    save_map(exact.maps[0], tmp_path / "map")
    after = camera_of(load_map(tmp_path / "map")[0])
    assert (after.line_delay_ns, after.image_delay_s) == (62_500, before.image_delay_s)
    np.testing.assert_allclose(
        before.delay_s(np.array([[3.0, 0.0], [3.0, 480.0]])), [-0.015, 0.015]
    )


OPTIONS = VIOptimizationOptions(num_iterations=60, calibration="fixed")


def ate_m(start: VIMap, data: SimulatedData, **free: bool) -> tuple[float, Camera]:
    """Return the absolute trajectory error of the optimised map, and its camera."""
    result, report = optimization.optimize(start, dataclasses.replace(OPTIONS, **free))
    assert all(row.sigma > 0.0 for row in report.calibration)
    return evaluation.evaluate_map(result, data.truth).ate_m, camera_of(result)


@pytest.mark.slow
def test_a_rolling_shutter_is_as_good_as_a_global_one() -> None:
    """Over twelve walks; those of one seed have different noise, and differ by up to a factor of three."""
    squares = np.zeros(3)  # global shutter; rolling, known; rolling, ignored
    for seed in range(1, 13):
        reference, rolling = (simulate(scenario(seed, 20.0, line)) for line in (0.0, LINE_DELAY_S))
        vi_map = rolling.maps[0]
        still = with_timing(vi_map, image_delay_s=0.0, line_delay_ns=0)
        known_m, camera = ate_m(vi_map, rolling)
        assert camera.line_delay_ns == 62_500
        errors_m = [ate_m(reference.maps[0], reference)[0], known_m, ate_m(still, rolling)[0]]
        squares += np.square(errors_m)
    global_m, known_m, ignored_m = np.sqrt(squares / 12)
    assert known_m <= 1.2 * global_m
    assert ignored_m > 2.0 * known_m


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_line_delays_are_estimated_from_nothing(seed: int) -> None:
    rolling = simulate(scenario(seed, 20.0))
    vi_map = rolling.maps[0]
    known_m, _ = ate_m(vi_map, rolling)
    for start, free in (
        (with_timing(vi_map, line_delay_ns=0), {}),
        (
            with_timing(vi_map, image_delay_s=0.0, line_delay_ns=0),
            {"fix_ncamera_time_offset": False},
        ),
    ):
        estimated_m, camera = ate_m(start, rolling, fix_ncamera_line_delay=False, **free)
        assert estimated_m <= 1.2 * known_m
        assert camera.line_delay_ns == pytest.approx(62_500, rel=0.03)
        assert camera.image_delay_s == pytest.approx(-0.015, abs=1e-3)


@pytest.mark.slow
def test_the_self_calibration_estimates_line_delays() -> None:
    data = simulate(scenario(1, 20.0))
    start = with_timing(data.maps[0], line_delay_ns=40_000)
    options = SelfCalibrationOptions(states="extrinsics_rotation,line_delay")
    calibration, report = calibrate(start, options)
    rig = next(s for s in calibration.sensors.sensors.values() if isinstance(s, CameraRig))
    assert rig.cameras[0].line_delay_ns == pytest.approx(62_500, rel=0.03)
    (row,) = [row for row in report.parameters if row.parameter.endswith("line delay")]
    assert 0.0 < row.sigma < 0.03 * LINE_DELAY_S
