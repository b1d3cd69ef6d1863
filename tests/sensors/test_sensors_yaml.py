"""sensors.yaml: real files, every kind of key, every kind of mistake."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from maplab_py.errors import MapError
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Camera, CameraRig, Distortion, Imu, OtherSensor, Projection, SensorSet
from maplab_py.sensors.camera import CAMERA_MODELS, DISTORTION_SIZE, INTRINSICS_SIZE
from maplab_py.sensors.sensors_yaml import parse_sensors, read_sensors, write_sensors
from maplab_py.sensors.wheels import wheel_scale, with_wheel_scale
from maplab_py.sensors.yaml_text import dump_yaml, parse_yaml
from tests.support.data import shared_data

IMU_ID, RIG_ID, CAMERA_ID = "a" * 32, "00000000000000000000000000000042", "c" * 32
WHEEL_ID = "d" * 32

FULL = f"""
my_top_level_key: [1, two, 3.5]
sensors:
  - id: {IMU_ID}
    sensor_type: IMU
    topic: /imu0
    description: an IMU
    sigmas: {{acc_noise_density: 1e-2, gyro_noise_density: 2e-4, my_sigma: 0.25}}
    gravity_magnitude_mps2: 9.8
    my_imu_key: {{deep: {{deeper: 12:30}}}}
    imu_intrinsics:
      T_g: {{rows: 3, cols: 3, data: [[1.01, 0.001, 0], [0, 0.99, 0], [0, 0, 1]]}}
      T_a: {{rows: 3, cols: 3, data: [1, 0, 0.002, 0, 1, 0, 0, 0, 1.02]}}
      R_AI: {{rows: 3, cols: 3, data: [[0, -1, 0], [1, 0, 0], [0, 0, 1]]}}
  - id: {RIG_ID}
    sensor_type: NCAMERA
    topic: ''
    description: a rig
    T_G_B_fixed_covariance: {{rows: 1, cols: 1, data: [0.1]}}
    cameras:
      - camera:
          id: {CAMERA_ID}
          sensor_type: CAMERA
          topic: /cam0
          description: a camera
          line-delay-nanoseconds: 0
          compressed: false
          image_height: 480
          image_width: 752
          type: unified-projection
          intrinsics: {{rows: 5, cols: 1, data: [[0.9], [400], [401], [376], [240]]}}
          distortion:
            type: equidistant
            comment: no
            parameters: {{rows: 4, cols: 1, data: [0.1, 0.02, 1e-05, 0.0]}}
        T_C_B:
          rows: 4
          cols: 4
          data: [0, 1, 0, 0.1, -1, 0, 0, 0.2, 0, 0, 1, 0.3, 0, 0, 0, 1]
        time_offset_ns: -120000
        my_mount_key: kept
  - id: {WHEEL_ID}
    sensor_type: WHEEL_ODOMETRY
    T_St_Stp1_fixed_covariance: {{rows: 2, cols: 1, data: [1, 2]}}
extrinsics:
  - sensor_id: {IMU_ID}
    base_sensor_id: {IMU_ID}
    T_B_S: {{rows: 4, cols: 4, data: [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1]}}
  - sensor_id: {RIG_ID}
    base_sensor_id: {IMU_ID}
    T_S_B: {{rows: 4, cols: 4, data: [[1,0,0,1], [0,1,0,2], [0,0,1,3], [0,0,0,1]]}}
    my_extrinsics_key: 7
"""


def plain(text: str) -> object:
    return parse_yaml(text, "test")


def test_every_key_is_understood() -> None:
    sensors = parse_sensors(FULL, "sensors.yaml")
    imu = sensors.imu(IMU_ID)
    assert (imu.acc_noise_density, imu.gyro_noise_density) == (0.01, 2e-4)
    assert imu.gyro_bias_random_walk_noise_density == 1e-4
    assert imu.gravity_magnitude_mps2 == 9.8
    assert imu.intrinsics is not None
    assert imu.intrinsics.T_a[0, 2] == 0.002
    assert imu.intrinsics.R_A_I[1, 0] == 1.0
    rig = sensors.camera_rig(RIG_ID)
    camera = rig.cameras[0]
    assert (camera.projection, camera.distortion) == (Projection.UNIFIED, Distortion.EQUIDISTANT)
    assert camera.intrinsics.tolist() == [0.9, 400, 401, 376, 240]
    assert camera.distortion_parameters.tolist() == [0.1, 0.02, 1e-5, 0.0]
    assert (camera.width_px, camera.height_px, camera.time_offset_ns) == (752, 480, -120000)
    assert np.allclose(se3.to_matrix(rig.T_B_C[0])[:3, 3], [0.2, -0.1, -0.3])
    assert np.allclose(sensors.T_B_S(RIG_ID)[4:], [-1, -2, -3])
    assert isinstance(sensors.sensors[WHEEL_ID], OtherSensor)
    assert sensors.without_extrinsics() == (WHEEL_ID,)


def test_unknown_keys_survive_at_every_level() -> None:
    text = write_sensors(parse_sensors(FULL, "sensors.yaml"))
    written, given = plain(text), plain(FULL)
    assert written["my_top_level_key"] == [1, "two", 3.5]
    imu, rig, wheel = written["sensors"]
    assert imu["sigmas"]["my_sigma"] == 0.25
    assert imu["my_imu_key"] == {"deep": {"deeper": "12:30"}}
    assert rig["T_G_B_fixed_covariance"] == {"rows": 1, "cols": 1, "data": [0.1]}
    assert wheel == given["sensors"][2]
    camera = rig["cameras"][0]
    assert camera["camera"]["compressed"] is False
    assert camera["camera"]["line-delay-nanoseconds"] == 0
    assert camera["camera"]["distortion"]["comment"] == "no"
    assert camera["my_mount_key"] == "kept"
    assert camera["T_C_B"] == given["sensors"][1]["cameras"][0]["T_C_B"]
    assert "T_B_C" not in camera
    assert written["extrinsics"] == given["extrinsics"]
    assert write_sensors(parse_sensors(text, "again")) == text


def test_line_delays_are_read_and_written() -> None:
    text = FULL.replace("line-delay-nanoseconds: 0", "line-delay-nanoseconds: 62500")
    sensors = parse_sensors(text, "sensors.yaml")
    rig = sensors.camera_rig(RIG_ID)
    assert rig.cameras[0].line_delay_ns == 62_500
    assert parse_sensors(write_sensors(sensors), "again").camera_rig(RIG_ID).cameras[0].is_moving
    for delay_ns in (70_000, -70_000, 0):
        camera = dataclasses.replace(rig.cameras[0], line_delay_ns=delay_ns)
        changed = {**sensors.sensors, RIG_ID: dataclasses.replace(rig, cameras=(camera,))}
        written = write_sensors(dataclasses.replace(sensors, sensors=changed))
        again = parse_sensors(written, "again").camera_rig(RIG_ID).cameras[0]
        assert again.line_delay_ns == delay_ns
        assert again.is_moving == (delay_ns != 0)
    for wrong, message in (
        ("6.25e-5", "must be a whole number"),
        ("62500000", r"30 s for an image of 480: give the time between two rows, in nanoseconds"),
    ):
        with pytest.raises(
            MapError, match=f"camera {CAMERA_ID}.*line-delay-nanoseconds.*{message}"
        ):
            parse_sensors(text.replace("62500", wrong), "sensors.yaml")


def test_wheel_scales_are_keys_of_their_sensor() -> None:
    sensors = parse_sensors(FULL, "sensors.yaml")
    assert wheel_scale(sensors, WHEEL_ID) == wheel_scale(sensors, IMU_ID) == 1.0
    scaled = with_wheel_scale(sensors, WHEEL_ID, 1.0 + 1e-13)
    again = parse_sensors(write_sensors(scaled), "again")
    assert wheel_scale(again, WHEEL_ID) == 1.0 + 1e-13
    assert wheel_scale(sensors, WHEEL_ID) == 1.0
    for value in (0.0, -1.0, float("nan")):
        wrong = with_wheel_scale(sensors, WHEEL_ID, value)
        with pytest.raises(MapError, match=f"sensor {WHEEL_ID}: key 'wheel_scale'"):
            wheel_scale(wrong, WHEEL_ID)
    with pytest.raises(MapError, match="no wheel sensor"):
        with_wheel_scale(sensors, RIG_ID, 1.0)


def test_other_yaml_readers_agree_on_the_written_text() -> None:
    value = yaml.safe_load(write_sensors(parse_sensors(FULL, "sensors.yaml")))
    assert value["sensors"][1]["id"] == RIG_ID
    camera = value["sensors"][1]["cameras"][0]["camera"]
    assert camera["distortion"]["parameters"]["data"] == [0.1, 0.02, 1e-5, 0.0]


def test_a_changed_pose_is_written_anew() -> None:
    sensors = parse_sensors(FULL, "sensors.yaml")
    rig = sensors.camera_rig(RIG_ID)
    moved = se3.retract(rig.T_B_C, np.array([0.1, 0, 0, 0, 0.2, 0]))
    changed = dataclasses.replace(
        sensors, sensors={**sensors.sensors, RIG_ID: dataclasses.replace(rig, T_B_C=moved)}
    )
    again = parse_sensors(write_sensors(changed), "again").camera_rig(RIG_ID)
    assert np.allclose(again.T_B_C, moved, atol=1e-15)


@pytest.mark.parametrize(("projection", "distortion"), CAMERA_MODELS)
def test_all_camera_models_round_trip_bit_for_bit(projection, distortion) -> None:
    rng = np.random.default_rng(3)
    mirror = rng.uniform(0.1, 0.9, INTRINSICS_SIZE[projection] - 4)
    camera = Camera(
        id=CAMERA_ID,
        projection=projection,
        distortion=distortion,
        intrinsics=np.concatenate([mirror, rng.uniform(1.0, 500.0, 4)]),
        distortion_parameters=rng.normal(size=DISTORTION_SIZE[distortion]) * 1e-7,
        width_px=640,
        height_px=480,
    )
    T = se3.make(so3.exp(rng.normal(size=3)), rng.normal(size=3))[None]
    text = write_sensors(SensorSet({RIG_ID: CameraRig(RIG_ID, (camera,), T)}))
    read = parse_sensors(text, "x").camera_rig(RIG_ID)
    assert np.array_equal(read.cameras[0].intrinsics, camera.intrinsics)
    assert np.array_equal(read.cameras[0].distortion_parameters, camera.distortion_parameters)
    assert np.max(np.abs(se3.local(read.T_B_C, T))) < 1e-15


def test_distortion_none_needs_no_parameters() -> None:
    text = FULL.replace("type: equidistant", "type: none")
    text = text.replace("parameters: {rows: 4, cols: 1, data: [0.1, 0.02, 1e-05, 0.0]}", "")
    camera = parse_sensors(text, "x").camera_rig(RIG_ID).cameras[0]
    assert camera.distortion is Distortion.NONE
    assert camera.distortion_parameters.shape == (0,)


def test_lidar_cameras_are_kept_as_found() -> None:
    text = FULL.replace("type: unified-projection", "type: camera-3d-lidar")
    sensors = parse_sensors(text, "x")
    assert isinstance(sensors.sensors[RIG_ID], OtherSensor)
    assert plain(write_sensors(sensors))["sensors"][1] == plain(text)["sensors"][1]


def test_camera_poses_on_the_imu() -> None:
    sensors = parse_sensors(FULL, "x")
    T = sensors.T_I_C(IMU_ID, RIG_ID)
    expected = se3.compose(sensors.T_B_S(RIG_ID), sensors.camera_rig(RIG_ID).T_B_C)
    assert T.shape == (1, 7)
    assert np.allclose(T, expected)


def test_camera_poses_when_neither_is_the_base() -> None:
    text = FULL.replace(f"base_sensor_id: {IMU_ID}", f"base_sensor_id: {WHEEL_ID}")
    text = text.replace("data: [1,0,0,0, 0,1,0,0,", "data: [1,0,0,5, 0,1,0,0,")
    sensors = parse_sensors(text, "x")
    expected = parse_sensors(FULL, "x").T_I_C(IMU_ID, RIG_ID) - [0, 0, 0, 0, 5, 0, 0]
    assert np.allclose(sensors.T_I_C(IMU_ID, RIG_ID), expected)
    with pytest.raises(MapError, match="no IMU with id"):
        sensors.T_I_C(WHEEL_ID, RIG_ID)


BAD = [
    ("  - id: " + IMU_ID, "  - identity: 1", "key 'id' is missing"),
    (f"id: {CAMERA_ID}", f"id: {IMU_ID}", "given to two sensors"),
    (f"id: {CAMERA_ID}", "id: 12", "is not 32 hexadecimal digits"),
    (f"id: {CAMERA_ID}", "id: " + "0" * 32, "all zero"),
    ("sensor_type: IMU", "", f"sensor {IMU_ID}: key 'sensor_type' is missing"),
    ("acc_noise_density: 1e-2", "acc_noise_density: -1", "'acc_noise_density' must be positive"),
    ("acc_noise_density: 1e-2", "acc_noise_density: .nan", "must be a finite number"),
    ("acc_noise_density: 1e-2", "acc_noise_density: x", "must be a finite number"),
    ("image_height: 480", "", f"camera {CAMERA_ID}: key 'image_height' is missing"),
    ("image_height: 480", "image_height: 480.5", "must be a whole number"),
    ("image_height: 480", "image_height: 0", "must be positive"),
    (
        "type: unified-projection",
        "type: fancy",
        "'fancy' is not one of pinhole, unified-projection",
    ),
    ("type: equidistant", "type: odd", "camera .*distortion: key 'type': 'odd' is not one of"),
    ("type: unified-projection", "type: pinhole", "'intrinsics' needs 4 values, not 5"),
    ("[[0.9], [400]", "[[0.9], [-400]", "focal lengths must be positive"),
    ("[[0.9], [400]", "[[0.9], [.inf]", "not finite numbers"),
    ("[[0.9], [400]", "[[0.9, 1], [400]", "rows of unequal length"),
    ("data: [0.1, 0.02, 1e-05, 0.0]", "data: [0.1, 0.02]", "4 x 1 is declared, but data has 2"),
    ("0.1, -1, 0, 0, 0.2", "0.1, -1, 0.5, 0, 0.2", "'T_C_B' is not a rotation matrix"),
    ("0, 0, 1, 0.3, 0, 0, 0, 1]", "0, 0, 1, 0.3, 0, 0, 0, 2]", "last row must be 0 0 0 1"),
    ("data: [0, 1, 0, 0.1,", "data: [0, -1, 0, 0.1,", "is not a rotation matrix"),
    ("T_C_B:", "T_B_X:", "key 'T_B_C' is missing"),
    ("        T_C_B:", "        T_B_C: 1\n        T_C_B:", "cannot be combined"),
    (f"sensor_id: {RIG_ID}", f"sensor_id: {CAMERA_ID}", "there is no sensor"),
    (f"sensor_id: {RIG_ID}", f"sensor_id: {IMU_ID}", "two entries|its own base"),
    ("data: [1,0,0,0, 0,1,0,0,", "data: [1,0,0,5, 0,1,0,0,", "its own base"),
    ("[0, 0.99, 0], [0, 0, 1]]", "[0.1, 0.99, 0], [0, 0, 1]]", "'T_g' must be upper triangular"),
    ("time_offset_ns: -120000", "time_offset_ns: soon", "must be a whole number"),
    ("sensors:", "sensors: {a: 1}\nothers:", "key 'sensors' must be a list"),
    ("sensors:", "sensor:", "key 'sensors' is missing"),
    ("topic: /imu0", "topic: [1, 2]", "key 'topic' must be text"),
    ("topic: /imu0", "topic: /a\n    topic: /b", "key 'topic' twice"),
    ("topic: /imu0", "topic: {", "not valid YAML"),
]


@pytest.mark.parametrize(("old", "new", "message"), BAD)
def test_bad_input_is_one_clear_line(old: str, new: str, message: str) -> None:
    assert old in FULL
    with pytest.raises(MapError, match=message) as caught:
        parse_sensors(FULL.replace(old, new, 1), "some/sensors.yaml")
    assert re.match(r"some/sensors.yaml(:\d+)?: ", str(caught.value))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["- 1\n", "just text", "3", "sensors: [1]", "sensors: [null]"])
def test_wrong_structure_is_refused(text: str) -> None:
    with pytest.raises(MapError, match=r"sensors.yaml: key-value pairs are expected"):
        parse_sensors(text, "sensors.yaml")


def test_base_sensors_in_a_circle_are_refused() -> None:
    text = FULL.replace(f"base_sensor_id: {IMU_ID}", f"base_sensor_id: {RIG_ID}", 1)
    with pytest.raises(MapError, match="cycle"):
        parse_sensors(text, "x").T_I_C(IMU_ID, RIG_ID)


def test_an_empty_file_has_no_sensors() -> None:
    assert parse_sensors("", "x").sensors == {}
    assert parse_sensors("sensors: []\nextrinsics: []", "x").sensors == {}


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"cannot read .*absent"):
        read_sensors(tmp_path / "absent.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(MapError, match="not UTF-8"):
        read_sensors(tmp_path / "binary.yaml")


def test_legacy_files(tmp_path: Path) -> None:
    (tmp_path / "ncamera.yaml").write_text(
        f"label: my rig\nid: {RIG_ID}\ncameras:\n"
        f"- camera: {{label: cam0, id: {CAMERA_ID}, line-delay-nanoseconds: 0, image_height: 480,\n"
        "    image_width: 752, type: pinhole, intrinsics: {cols: 1, rows: 4, data: [4, 4, 3, 2]},\n"
        "    distortion: {type: fisheye, parameters: {cols: 1, rows: 1, data: [0.9]}}}\n"
        "  T_B_C: {cols: 4, rows: 4, data: [1,0,0,7, 0,1,0,0, 0,0,1,0, 0,0,0,1]}\n"
    )
    (tmp_path / "imu.yaml").write_text(
        f"hardware_id: imu0\nid: {IMU_ID}\nsensor_type: IMU\n"
        "imu_sigmas: {acc_noise_density: 0.5, gyro_noise_density: 0.25}\n"
    )
    rigs, imus = read_sensors(tmp_path / "ncamera.yaml"), read_sensors(tmp_path / "imu.yaml")
    imu, rig = imus.imu(IMU_ID), rigs.camera_rig(RIG_ID)
    assert (imu.topic, imu.acc_noise_density, imu.gyro_noise_density) == ("imu0", 0.5, 0.25)
    assert (rig.description, rig.cameras[0].description) == ("my rig", "cam0")
    assert rig.T_B_C[0, 4] == 7.0
    again = parse_sensors(write_sensors(rigs), "2.x")
    assert again.camera_rig(RIG_ID).cameras[0].distortion is Distortion.FOV


def _differences(a: object, b: object, path: str = "") -> list[str]:
    if isinstance(a, dict) and isinstance(b, dict):
        found = [f"{path}/{key}" for key in a.keys() ^ b.keys()]
        return found + [
            d for k in a.keys() & b.keys() for d in _differences(a[k], b[k], f"{path}/{k}")
        ]
    if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        return [d for i in range(len(a)) for d in _differences(a[i], b[i], f"{path}/{i}")]
    return [] if a == b else [path]


def test_real_maps_are_written_back_without_a_difference() -> None:
    paths = sorted(shared_data("maplab_maps").rglob("sensors.yaml"))
    assert len(paths) >= 9
    for path in paths:
        text = write_sensors(read_sensors(path))
        assert _differences(plain(path.read_text()), plain(text)) == []


def test_real_euroc_mounting() -> None:
    folder = shared_data("maplab_maps/euroc_v1_01/euroc_v1_01_submap_0")
    sensors = read_sensors(folder / "vi_map" / "sensors.yaml")
    imu = next(s for s in sensors.sensors.values() if isinstance(s, Imu))
    rig = next(s for s in sensors.sensors.values() if isinstance(s, CameraRig))
    T = se3.to_matrix(sensors.T_I_C(imu.id, rig.id)[0])
    assert np.allclose(T[0], [0.01486554, -0.99988093, 0.0041403, -0.02164015], atol=1e-8)


@pytest.mark.parametrize(
    "scalar",
    ["1e-05", "12:30", "yes", "2019-01-01", "0123", "0x1f", "1_000", "null", "true", "'1'", "-.inf",
     "1.", "+5", "'~'", "''", "1234567890" * 3 + "12", "=", "a: b"],
)  # fmt: skip
def test_scalars_survive(scalar: str) -> None:
    value = parse_yaml(f"key: {scalar}" if ": " not in scalar else f"key: '{scalar}'", "x")
    assert parse_yaml(dump_yaml(value), "y") == value
    if scalar in ("12:30", "yes", "2019-01-01", "0123", "0x1f", "1_000", "+5"):
        assert value == {"key": scalar}
        assert scalar in dump_yaml(value)
