"""Maps for these tests: exact or noisy, with a device that is not what its calibration says."""

import dataclasses
from functools import cache

import numpy as np

from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.geometry import se3, so3
from maplab_py.sensors import CameraRig, Distortion, Imu, ImuIntrinsics, Projection, SensorSet
from maplab_py.vimap import VIMap
from maplab_py.vimap.consistency import check_consistency
from tests.support.scene import Scene, corrupted

INTRINSICS = ImuIntrinsics(
    T_g=np.array([[1.004, 0.003, -0.002], [0, 0.997, 0.003], [0, 0, 1.002]]),
    T_a=np.array([[0.99, -0.01, 0.008], [0, 1.012, 0.01], [0, 0, 0.985]]),
    R_A_I=so3.to_matrix(so3.exp([0.012, -0.015, 0.01])),
)
OPTIONS = SelfCalibrationOptions(
    segment_keyframes=10,
    segments_per_group=2,
    min_parallax_deg=0.0,
    imu_curvature=False,  # the samples fit the discrete integration
)
EXACT = dataclasses.replace(
    OPTIONS,
    loss="none",
    num_iterations=60,
    function_tolerance=1e-13,
    prior_focal_relative=1e4,
    prior_centre_px=1e6,
    prior_distortion=1e4,
    prior_rotation_deg=1e6,
    prior_position_m=1e4,
    prior_imu_scale=1e4,
    prior_imu_misalignment=1e4,
    prior_imu_rotation_deg=1e6,
    prior_time_offset_s=1e4,
    prior_gyro_bias_radps=1e5,
    prior_accel_bias_mps2=1e6,
    prior_velocity_mps=1e6,
)


@cache
def scene_map(
    vertices: int = 31,
    noise: float = 0.0,
    seed: int = 1,
    distortion: Distortion = Distortion.FOV,
    device_seed: int | None = None,
) -> VIMap:
    scene = Scene(
        vertices=vertices,
        noise=noise,
        seed=seed,
        device_seed=device_seed,
        models=((Projection.PINHOLE, distortion),),
        intrinsics=INTRINSICS,
    )
    return scene.make()


def assert_only_gaps(vi_map: VIMap) -> None:
    """Segments of a mission are joined by nothing; everything else must be as in any map."""
    broken = [one.rule for one in check_consistency(vi_map).errors]
    assert set(broken) <= {"vertex without an edge to the next of its mission"}


def device(vi_map: VIMap) -> tuple[Imu, CameraRig]:
    found = list(vi_map.sensors.sensors.values())
    return (
        next(one for one in found if isinstance(one, Imu)),
        next(one for one in found if isinstance(one, CameraRig)),
    )


def nominal(vi_map: VIMap) -> SensorSet:
    """What a data sheet says: no scale errors, round numbers, mounting by drawing."""
    imu, rig = device(vi_map)
    camera = rig.cameras[0]
    turned = se3.retract(rig.T_B_C, np.array([[0.006, -0.004, 0.005, 0.008, -0.006, 0.01]]))
    wrong = dataclasses.replace(
        camera,
        intrinsics=camera.intrinsics + np.array([3.0, -2.0, 4.0, -3.0]),
        distortion_parameters=camera.distortion_parameters * 1.01,
    )
    return dataclasses.replace(
        vi_map.sensors,
        sensors={
            imu.id: dataclasses.replace(imu, intrinsics=None),
            rig.id: dataclasses.replace(rig, cameras=(wrong,), T_B_C=turned),
        },
    )


def uncalibrated(vi_map: VIMap, seed: int = 7) -> VIMap:
    """Disturb states and forget the calibration."""
    disturbed = corrupted(
        vi_map,
        np.random.default_rng(seed),
        position_m=0.02,
        quaternion=0.003,
        landmark_m=0.02,
        velocity_mps=0.05,
        gyro_bias=2e-3,
        accel_bias=0.02,
    )
    return disturbed.replace(sensors=nominal(vi_map))
