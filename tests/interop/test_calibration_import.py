"""Calibration files of other programs: small files of every format, exports read back, wrong files."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplab_py.algorithms.self_calibration.device import device_of, with_calibration_file
from maplab_py.errors import MapError, MaplabError, UserError
from maplab_py.interop.calibration_export import exported
from maplab_py.interop.calibration_import import CalibrationFile, import_calibration
from maplab_py.sensors import Distortion, Projection, SensorSet
from maplab_py.sensors.camera import CAMERA_MODELS, Camera
from maplab_py.sensors.sensors_yaml import parse_sensors, write_sensors
from tests.algorithms.self_calibration.scenes import scene_map
from tests.support.scene import Scene

CAMCHAIN = """cam0:
  T_cam_imu:
  - [0.0, -1.0, 0.0, 0.01]
  - [1.0, 0.0, 0.0, 0.02]
  - [0.0, 0.0, 1.0, 0.03]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [0.1, -0.2, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [400.0, 401.0, 320.5, 240.5]
  resolution: [640, 480]
  rostopic: /cam0
  timeshift_cam_imu: 0.004
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: omni
  distortion_coeffs: [0.01, 0.02, 0.0, 0.0]
  distortion_model: radtan
  intrinsics: [1.5, 800.0, 802.0, 321.0, 241.0]
  resolution: [640, 480]
  rostopic: /cam1
"""
IMU = """accelerometer_noise_density: 0.01
accelerometer_random_walk: 0.0002
gyroscope_noise_density: 0.001
gyroscope_random_walk: 0.00003
rostopic: /imu0
update_rate: 200.0
"""
EUROC_CAMERA = """%YAML:1.0
sensor_type: camera
comment: left
T_BS:
  cols: 4
  rows: 4
  data: [0.0, 1.0, 0.0, -0.02,
         -1.0, 0.0, 0.0, 0.01,
         0.0, 0.0, 1.0, -0.03,
         0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [640, 480]
camera_model: pinhole
intrinsics: [400.0, 401.0, 320.5, 240.5] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [0.1, -0.2, 0.001, -0.002]
"""
EUROC_IMU = """%YAML:1.0
sensor_type: imu
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
rate_hz: 200
gyroscope_noise_density: 0.001
gyroscope_random_walk: 0.00003
accelerometer_noise_density: 0.01
accelerometer_random_walk: 0.0002
"""
BASALT_CAMERAS = [
    {
        "camera_type": "kb4",
        "intrinsics": {"fx": 190.0, "fy": 191.0, "cx": 254.0, "cy": 256.0}
        | {"k1": 0.003, "k2": 0.0007, "k3": -0.002, "k4": 0.0002},
    },
    {
        "camera_type": "ucm",
        "intrinsics": {"fx": 300.0, "fy": 302.0, "cx": 255.0, "cy": 257.0, "alpha": 0.6},
    },
]
BASALT = {
    "T_imu_cam": [
        {"px": 0.1, "py": 0.2, "pz": 0.3, "qx": 0.0, "qy": 0.0, "qz": 0.0, "qw": 1.0},
        {"px": 0.0, "py": 0.2, "pz": 0.3, "qx": 1.0, "qy": 0.0, "qz": 0.0, "qw": 0.0},
    ],
    "intrinsics": BASALT_CAMERAS,
    "resolution": [[512, 512], [512, 512]],
    "calib_accel_bias": [0.1, 0.2, 0.3, 0, 0, 0, 0, 0, 0],
    "calib_gyro_bias": [0.01, 0.02, 0.03, 0, 0, 0, 0, 0, 0, 0, 0, 0],
    "imu_update_rate": 200.0,
    "accel_noise_std": [0.016, 0.016, 0.02],
    "gyro_noise_std": [0.000282, 0.000282, 0.000282],
    "accel_bias_std": [0.001, 0.001, 0.001],
    "gyro_bias_std": [0.0001, 0.0001, 0.0001],
    "cam_time_offset_ns": 2_000_000,
    "vignette": [],
}


def written(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text)
    return path


def basalt(folder: Path, **changes: Any) -> Path:
    return written(folder, "calibration.json", json.dumps({"value0": {**BASALT, **changes}}))


def cameras(calibration: CalibrationFile) -> tuple[Camera, ...]:
    return calibration.sensors.camera_rig(calibration.rig_id).cameras


def as_printed(sensors: SensorSet) -> str:
    return write_sensors(parse_sensors(write_sensors(sensors), "again"))


def test_kalibr(tmp_path: Path) -> None:
    chain, imu = written(tmp_path, "chain.yaml", CAMCHAIN), written(tmp_path, "imu.yaml", IMU)
    result = import_calibration(chain, imu)
    assert result.format == "kalibr"
    first, second = cameras(result)
    assert (first.distortion, second.projection) == (Distortion.RADTAN, Projection.UNIFIED)
    assert second.intrinsics.tolist() == [1.5, 800.0, 802.0, 321.0, 241.0]
    assert (first.time_offset_ns, second.time_offset_ns) == (4_000_000, 0)
    T_I_C = result.sensors.T_I_C(result.imu_id, result.rig_id)
    np.testing.assert_allclose(T_I_C[0, 4:], [-0.02, 0.01, -0.03], atol=1e-15)
    # 10 cm along x of the first camera, which is -y of the IMU
    np.testing.assert_allclose(T_I_C[1, 4:], [-0.02, -0.09, -0.03], atol=1e-15)
    assert result.sensors.imu(result.imu_id).gyro_bias_random_walk_noise_density == 3e-5
    assert as_printed(result.sensors) == write_sensors(result.sensors)
    alone = import_calibration(imu)
    assert (alone.rig_id, alone.imu_id) == ("", result.imu_id)
    assert import_calibration(chain).imu_id == ""


def test_euroc(tmp_path: Path) -> None:
    for sensor, text in (("cam0", EUROC_CAMERA), ("imu0", EUROC_IMU)):
        (tmp_path / "mav0" / sensor).mkdir(parents=True)
        written(tmp_path / "mav0" / sensor, "sensor.yaml", text)
    camera, imu = (tmp_path / "mav0" / name / "sensor.yaml" for name in ("cam0", "imu0"))
    for result in (import_calibration(tmp_path), import_calibration(camera, imu)):
        assert result.format == "EuRoC"
        T_I_C = result.sensors.T_I_C(result.imu_id, result.rig_id)
        np.testing.assert_allclose(T_I_C[0, 4:], [-0.02, 0.01, -0.03], atol=1e-15)
        assert cameras(result)[0].distortion_parameters.tolist() == [0.1, -0.2, 0.001, -0.002]
    assert import_calibration(camera).imu_id == ""
    assert import_calibration(imu).rig_id == ""


def test_openvins(tmp_path: Path) -> None:
    chain = CAMCHAIN.replace("T_cn_cnm1", "T_imu_cam").replace("omni", "pinhole")
    written(tmp_path, "chain.yaml", "%YAML:1.0\n" + chain.replace("[1.5, 800", "[800"))
    model = "  model: kalibr\n  Tw:\n  - [1.01, 0, 0]\n  - [0, 1, 0]\n  - [0, 0, 1]\n"
    indented = "".join(f"  {line}\n" for line in IMU.splitlines())
    written(tmp_path, "imu.yaml", "%YAML:1.0\nimu0:\n" + indented + model)
    config = 'relative_config_imu: "imu.yaml"\nrelative_config_imucam: "chain.yaml"\n'
    written(tmp_path, "estimator_config.yaml", "%YAML:1.0\n" + config)
    result = import_calibration(tmp_path)
    assert result.format == "OpenVINS"
    intrinsics = result.sensors.imu(result.imu_id).intrinsics
    assert intrinsics is not None
    np.testing.assert_allclose(np.diag(intrinsics.T_g), [1.01, 1.0, 1.0], atol=1e-12)
    T_I_C = result.sensors.T_I_C(result.imu_id, result.rig_id)
    np.testing.assert_allclose(T_I_C[1, 4:], [-0.1, 0.0, 0.0], atol=1e-12)


def test_basalt(tmp_path: Path) -> None:
    result = import_calibration(basalt(tmp_path))
    assert result.format == "Basalt"
    first, second = cameras(result)
    assert (first.distortion, second.projection) == (Distortion.EQUIDISTANT, Projection.UNIFIED)
    assert first.distortion_parameters.tolist() == [0.003, 0.0007, -0.002, 0.0002]
    # alpha = 0.6: xi = 1.5, and focal lengths divided by 0.4
    np.testing.assert_allclose(second.intrinsics, [1.5, 750.0, 755.0, 255.0, 257.0])
    assert first.time_offset_ns == 2_000_000
    imu = result.sensors.imu(result.imu_id)
    assert (imu.acc_noise_density, imu.intrinsics) == (0.02, None)
    T_I_C = result.sensors.T_I_C(result.imu_id, result.rig_id)
    np.testing.assert_allclose(T_I_C[1], [1, 0, 0, 0, 0, 0.2, 0.3], atol=1e-15)


def test_a_map_takes_over_what_the_file_has(tmp_path: Path) -> None:
    vi_map = scene_map(distortion=Distortion.RADTAN)
    device = device_of(vi_map)
    camera = vi_map.sensors.camera_rig(device.rig).cameras[0]
    size = f"[{camera.width_px}, {camera.height_px}]"
    mono = CAMCHAIN.split("cam1:", maxsplit=1)[0].replace("[640, 480]", size)
    chain, imu = written(tmp_path, "chain.yaml", mono), written(tmp_path, "imu.yaml", IMU)
    both = with_calibration_file(vi_map, import_calibration(chain, imu)).sensors
    np.testing.assert_allclose(both.T_I_C(*device)[0, 4:], [-0.02, 0.01, -0.03], atol=1e-12)
    after = both.camera_rig(device.rig).cameras[0]
    assert after.intrinsics.tolist() == [400.0, 401.0, 320.5, 240.5]
    assert after.image_delay_s == pytest.approx(0.004)  # stamps of the map have no offset
    assert both.imu(device.imu).acc_noise_density == 0.01
    rolling = dataclasses.replace(camera, line_delay_ns=50_000)
    rig = dataclasses.replace(vi_map.sensors.camera_rig(device.rig), cameras=(rolling,))
    sensors = {**vi_map.sensors.sensors, rig.id: rig}
    reading = vi_map.replace(sensors=dataclasses.replace(vi_map.sensors, sensors=sensors))
    read = with_calibration_file(reading, import_calibration(chain, imu)).sensors
    assert read.camera_rig(device.rig).cameras[0].line_delay_ns == 50_000  # the file has none
    kept = with_calibration_file(vi_map, import_calibration(imu), imu_noise=False).sensors
    assert (
        kept.imu(device.imu).acc_noise_density == vi_map.sensors.imu(device.imu).acc_noise_density
    )
    no_imu = with_calibration_file(vi_map, import_calibration(chain)).sensors
    np.testing.assert_allclose(
        no_imu.T_I_C(*device), vi_map.sensors.T_I_C(*device), atol=1e-12
    )  # the first camera stays where it is
    noise_only = with_calibration_file(vi_map, import_calibration(imu)).sensors
    assert noise_only.imu(device.imu).intrinsics is not None
    wrong = written(tmp_path, "small.yaml", mono.replace(size, "[320, 240]"))
    with pytest.raises(UserError, match="320 x 240"):
        with_calibration_file(vi_map, import_calibration(wrong))
    with pytest.raises(UserError, match="2 cameras"):
        with_calibration_file(
            vi_map,
            import_calibration(
                written(tmp_path, "two.yaml", CAMCHAIN.replace("[640, 480]", size)), imu
            ),
        )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (CAMCHAIN.replace("640, 480", "640"), "'resolution' needs 2"),
        (CAMCHAIN.replace("[1.0, 0.0, 0.0, 0.02]", "[1.0, 1.0, 0.0, 0.02]"), "not a rotation"),
        (CAMCHAIN.replace("401.0", ".nan"), "not finite"),
        ("cam0: 3\n", "key-value pairs"),
        ("cam0: [", "not valid YAML"),
        (IMU.replace("0.01", "-1.0"), "must be positive"),
        ("", "key-value pairs"),
    ],
)
def test_wrong_files_are_refused_by_name(text: str, message: str, tmp_path: Path) -> None:
    path = written(tmp_path, "wrong.yaml", text)
    with pytest.raises(MaplabError, match=message) as error:
        import_calibration(path)
    assert "wrong.yaml" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"intrinsics": BASALT_CAMERAS[:1]}, "entry per camera"),
        ({"intrinsics": [{"camera_type": "ds", "intrinsics": {}}] * 2}, "'fx' is missing"),
        ({"intrinsics": [{"camera_type": "ftheta", "intrinsics": {}}] * 2}, "'ftheta' is not"),
        ({"calib_accel_bias": [0.0] * 6}, "needs 9"),
        ({"accel_noise_std": [0.0] * 3}, "must be positive"),
        ({"cam_time_offset_ns": 10**12}, "below 10 s"),
        ({"T_imu_cam": [dict.fromkeys(BASALT["T_imu_cam"][0], 0.0)] * 2}, "unit length"),  # type: ignore[index]
        ({"resolution": [[0, 1], [1, 1]]}, "positive whole"),
    ],
)
def test_wrong_basalt_files(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(MapError, match=message):
        import_calibration(basalt(tmp_path, **changes))


def test_basalt_cut_anywhere_is_an_error_of_one_line(tmp_path: Path) -> None:
    text = basalt(tmp_path).read_text()
    for end in range(0, len(text) - 1, 97):
        with pytest.raises(MapError) as error:
            import_calibration(written(tmp_path, "cut.json", text[:end]))
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("kind", "more", "projection", "distortion"),
    [
        ("pinhole-radtan8", {"k3": 0.0}, Projection.PINHOLE, Distortion.RADTAN),
        ("pinhole-radtan8", {"k3": 0.02}, Projection.PINHOLE, Distortion.RADTAN5),
        ("pinhole-radtan8", {"k5": 0.1, "rpmax": 0.0}, Projection.PINHOLE, Distortion.RATIONAL),
        ("ds", {"xi": -0.2, "alpha": 0.6}, Projection.DOUBLE_SPHERE, Distortion.NONE),
        ("eucm", {"alpha": 0.6, "beta": 1.1}, Projection.EXTENDED_UNIFIED, Distortion.NONE),
    ],
)
def test_basalt_models_there_and_back(
    kind: str,
    more: dict[str, float],
    projection: Projection,
    distortion: Distortion,
    tmp_path: Path,
) -> None:
    pinhole = {"fx": 300.0, "fy": 301.0, "cx": 255.0, "cy": 256.0}
    lens = {"k1": 0.1, "k2": 0.0, "p1": 0.0, "p2": 0.0} if kind == "pinhole-radtan8" else {}
    entry = {"camera_type": kind, "intrinsics": {**pinhole, **lens, **more}}
    result = import_calibration(basalt(tmp_path, intrinsics=[entry] * 2))
    camera = cameras(result)[0]
    assert (camera.projection, camera.distortion) == (projection, distortion)
    files = exported(result.sensors, result.imu_id, result.rig_id, "basalt", imu_rate_hz=200.0)
    again = cameras(import_calibration(written(tmp_path, "again.json", files["calibration.json"])))[
        0
    ]
    np.testing.assert_array_equal(again.intrinsics, camera.intrinsics)
    np.testing.assert_array_equal(again.distortion_parameters, camera.distortion_parameters)


@pytest.mark.parametrize("form", ["kalibr", "basalt"])
@pytest.mark.parametrize("model", CAMERA_MODELS, ids=lambda m: "-".join(x.value for x in m))
def test_every_camera_comes_back_or_is_refused(
    model: tuple[Projection, Distortion], form: str, tmp_path: Path
) -> None:
    vi_map = Scene(vertices=3, models=(model,)).make()
    device = device_of(vi_map)
    if (
        model[1] in (Distortion.RADTAN5, Distortion.RATIONAL)
        if form == "kalibr"
        else model[0] is Projection.UNIFIED and model[1] is not Distortion.NONE
    ):
        with pytest.raises(UserError, match=rf"no .*{model[1].value} distortion"):
            exported(vi_map.sensors, *device, form, imu_rate_hz=200.0)
        return
    files = exported(vi_map.sensors, *device, form, imu_rate_hz=200.0)
    paths = [written(tmp_path, name, text) for name, text in files.items()]
    (again,) = cameras(import_calibration(*sorted(paths)))
    (camera,) = vi_map.sensors.camera_rig(device[1]).cameras
    assert (again.projection, again.distortion) == model
    np.testing.assert_allclose(again.intrinsics, camera.intrinsics, rtol=1e-14)
    np.testing.assert_array_equal(again.distortion_parameters, camera.distortion_parameters)


def test_basalt_parameters_that_form_no_camera_are_refused(tmp_path: Path) -> None:
    values = {"fx": 1.0, "fy": 1.0, "cx": 1.0, "cy": 1.0, "xi": 0.1, "alpha": 2.0}
    wrong = [{"camera_type": "ds", "intrinsics": values}] * 2
    with pytest.raises(MapError, match=r"calibration.json.*0 <= alpha <= 1"):
        import_calibration(basalt(tmp_path, intrinsics=wrong))


def test_an_imu_whose_frame_turns_needs_its_cameras(tmp_path: Path) -> None:
    vi_map = scene_map(distortion=Distortion.RADTAN)
    files = exported(vi_map.sensors, *device_of(vi_map), "kalibr", imu_rate_hz=200.0)
    with pytest.raises(UserError, match="import the camera chain"):
        import_calibration(written(tmp_path, "imu.yaml", files["imu.yaml"]))
    with pytest.raises(UserError, match="belongs to a camera chain"):
        import_calibration(basalt(tmp_path), tmp_path / "imu.yaml")
