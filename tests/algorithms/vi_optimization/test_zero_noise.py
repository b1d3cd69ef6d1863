"""Perfect measurements bring disturbed maps back to the truth, to 1e-8 m and 1e-8 rad."""

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.geometry import se3, so3
from maplab_py.sensors import CameraRig, Distortion, ImuIntrinsics, Projection
from maplab_py.vimap import VIMap
from tests.support.scene import EVERY_MODEL, Scene, aligned, corrupted

EXACT = VIOptimizationOptions(
    num_iterations=25,
    loss="none",
    function_tolerance=1e-4,
    gradient_tolerance=0.0,
    parameter_tolerance=1e-14,
)
INTRINSICS = ImuIntrinsics(
    T_g=np.array([[1.02, 0.01, -0.02], [0, 0.97, 0.03], [0, 0, 1.01]]),
    T_a=np.array([[0.99, -0.02, 0.01], [0, 1.03, 0.02], [0, 0, 0.98]]),
    R_A_I=so3.to_matrix(so3.exp([0.02, -0.03, 0.01])),
)
SCENES = {
    **{f"{p.value}, {d.value}": Scene(vertices=8, models=((p, d),)) for p, d in EVERY_MODEL},
    "rig of two models": Scene(
        vertices=8,
        models=((Projection.PINHOLE, Distortion.NONE), (Projection.PINHOLE, Distortion.FOV)),
    ),
    "IMU with scale and misalignment": Scene(intrinsics=INTRINSICS),
    "gravity of the moon": Scene(gravity_mps2=1.62),
    "two missions in each other's landmarks": Scene(missions=2, vertices=8),
    "slow IMU": Scene(rate_hz=50),
}


SLOW = list(SCENES)[2:7]
"""Five of the eight camera models; the other three, and rigs, are part of every run."""


def disturbed(vi_map: VIMap, seed: int = 7) -> VIMap:
    return corrupted(
        vi_map,
        np.random.default_rng(seed),
        position_m=0.02,
        quaternion=0.005,
        landmark_m=0.02,
        velocity_mps=0.05,
        gyro_bias=2e-3,
        accel_bias=0.02,
    )


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in SCENES],
)
def test_disturbed_map_returns_to_the_truth(name: str) -> None:
    truth = SCENES[name].make()
    result, report = optimize(disturbed(truth), EXACT)
    assert report.gauge == "position and heading of 1 cluster"
    assert report.observations_not_used == report.observations_rejected == 0
    T_G_I = aligned(result.T_G_I, truth.T_G_I)
    assert np.abs(se3.local(truth.T_G_I, T_G_I)).max() <= 1e-8
    p_I = result.landmarks.p_I - truth.landmarks.p_I
    assert np.abs(p_I).max() <= 1e-8
    for state, tolerance in (("gyro_bias", 1e-8), ("accel_bias", 1e-7)):
        difference = getattr(result.vertices, state) - getattr(truth.vertices, state)
        assert np.abs(difference).max() <= tolerance


def test_images_alone_return_the_truth_up_to_a_similarity() -> None:
    truth = Scene().make()
    result, report = optimize(disturbed(truth), dataclasses.replace(EXACT, include_inertial=False))
    assert report.gauge == "pose and scale of 1 cluster"
    got, wanted = camera_poses(result), camera_poses(truth)
    # the camera centres are what images know up to scale: the lever arm to the IMU does not scale
    offset, offset_wanted = got[:, 4:] - got[0, 4:], wanted[:, 4:] - wanted[0, 4:]
    scale = np.linalg.norm(offset_wanted[-1]) / np.linalg.norm(offset[-1])
    q_new_old = so3.multiply(wanted[0, :4], so3.inverse(got[0, :4]))
    np.testing.assert_allclose(
        scale * so3.rotate(q_new_old, offset), offset_wanted, rtol=0.0, atol=1e-8
    )
    turned = so3.multiply(q_new_old, got[:, :4])
    error = so3.log(so3.multiply(so3.inverse(wanted[:, :4]), turned))
    np.testing.assert_allclose(error, 0.0, atol=1e-8)


def camera_poses(vi_map: VIMap) -> NDArray[np.float64]:
    """Return T_G_C of the first camera at every vertex (V, 7)."""
    rig = next(s for s in vi_map.sensors.sensors.values() if isinstance(s, CameraRig))
    return se3.compose(vi_map.T_G_I, rig.T_B_C[0])


def test_gravity_is_the_maps_unless_the_flag_says_otherwise() -> None:
    moon = Scene(gravity_mps2=1.62).make()
    _, own = optimize(moon, EXACT)
    assert own.cost_before <= 1e-12
    options = dataclasses.replace(EXACT, gravity_magnitude_mps2=9.81)
    _, earth = optimize(moon, options)
    assert earth.cost_before > 1e3
    same = dataclasses.replace(EXACT, gravity_magnitude_mps2=1.62)
    assert optimize(moon, same)[1].cost_before <= 1e-12
