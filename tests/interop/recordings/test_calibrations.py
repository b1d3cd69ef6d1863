"""Calibrations: kalibr's files of the real data sets, what we export, sensors.yaml, and wrong files."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import MapError, MaplabError, UserError
from maplab_py.geometry import se3, so3
from maplab_py.interop.calibration_export import exported
from maplab_py.interop.calibration_import import device_of, import_calibration, read_calibration
from maplab_py.interop.device import DeviceOptions, RecordedSensors, make_device
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.interop.recordings.reader_choice import open_recording
from maplab_py.sensors import Camera, Distortion, Imu, ImuIntrinsics, Projection
from maplab_py.sensors.sensors_yaml import write_sensors
from tests.interop.recordings.written import make_content, write_calibration, write_folder
from tests.interop.test_calibration_import import CAMCHAIN, IMU
from tests.support.data import shared_data


def test_kalibr_of_euroc() -> None:
    device = read_calibration(
        shared_data("euroc_imu/kalibr_imucam_chain.yaml"),
        shared_data("euroc_imu/kalibr_imu_chain.yaml"),
    )
    first, second = device.cameras
    assert (first.projection, first.distortion) == (Projection.PINHOLE, Distortion.RADTAN)
    assert (first.width_px, first.height_px, first.topic) == (752, 480, "/cam0/image_raw")
    assert first.intrinsics.tolist() == [458.654, 457.296, 367.215, 248.375]
    assert second.distortion_parameters.tolist() == [
        -0.28368365,
        0.07451284,
        -1.0473e-4,
        -3.555907e-05,
    ]
    p_I_C = [[-0.0216401454975, -0.064676986768, 0.00981073058949]]
    np.testing.assert_allclose(device.T_I_C[:1, 4:], p_I_C, atol=1e-12)
    # straight ahead of the camera is z of C: third column of T_imu_cam
    ahead = se3.transform(device.T_I_C[1], [0.0, 0.0, 1.0]) - device.T_I_C[1, 4:]
    np.testing.assert_allclose(ahead, [0.0182237714554, 0.0251588363115, 0.999517347078], atol=1e-9)
    imu = device.imu
    assert imu is not None
    assert (imu.acc_noise_density, imu.acc_bias_random_walk_noise_density) == (2e-3, 3e-3)
    assert (imu.gyro_noise_density, imu.gyro_bias_random_walk_noise_density) == (
        1.6968e-4,
        1.9393e-5,
    )
    assert (imu.topic, imu.intrinsics) == ("/imu0", None)
    folder = import_calibration(shared_data("euroc_mh01_10s/mav0"))
    np.testing.assert_allclose(folder.T_I_C, device.T_I_C, atol=1e-12)


def _device(*, intrinsics: bool) -> RecordedSensors:
    rng = np.random.default_rng(2)
    cameras = [
        Camera(
            "",
            Projection.PINHOLE,
            Distortion.EQUIDISTANT,
            np.array([300.0, 301.0, 320.0, 240.0 + row]),
            rng.normal(size=4) * 0.01,
            640,
            480,
            topic=f"/cam{row}",
            time_offset_ns=1_500_000,
            line_delay_ns=-15_000,
        )
        for row in range(2)
    ]
    T_I_C = se3.make(so3.exp(rng.normal(size=(2, 3))), rng.normal(size=(2, 3)) * 0.1)
    scale = ImuIntrinsics(
        np.eye(3) + np.triu(rng.normal(size=(3, 3)) * 0.02),
        np.eye(3) + np.triu(rng.normal(size=(3, 3)) * 0.02),
        so3.to_matrix(so3.exp(rng.normal(size=3) * 0.05)),
    )
    imu = Imu("", 2e-3, 3e-3, 1e-4, 2e-5, topic="/imu", intrinsics=scale if intrinsics else None)
    return make_device(cameras, T_I_C, imu)


@pytest.mark.parametrize("form", ["kalibr", "openvins"])
@pytest.mark.parametrize("intrinsics", [False, True])
def test_what_we_export_reads_back(tmp_path: Path, form: str, intrinsics: bool) -> None:
    device = _device(intrinsics=intrinsics)
    files = exported(device.sensors, device.imu_id, device.rig_id, form, imu_rate_hz=200.0)
    paths = []
    for name, text in files.items():
        paths.append(tmp_path / name)
        paths[-1].write_text(text)
    again = read_calibration(*paths)
    np.testing.assert_allclose(again.T_I_C, device.T_I_C, atol=1e-9)
    for ours, theirs in zip(again.cameras, device.cameras, strict=True):
        assert ours.intrinsics.tolist() == theirs.intrinsics.tolist()
        assert (ours.time_offset_ns, ours.topic) == (1_500_000, theirs.topic)
        assert ours.line_delay_ns == -15_000
    assert again.imu is not None
    assert device.imu is not None
    assert again.imu.acc_noise_density == 2e-3
    wanted, read = device.imu.intrinsics, again.imu.intrinsics
    if wanted is None:
        assert read is None or np.abs(read.T_g - np.eye(3)).max() < 1e-12
        return
    assert read is not None
    for name in ("T_g", "T_a", "R_A_I"):
        np.testing.assert_allclose(getattr(read, name), getattr(wanted, name), atol=1e-12)


def test_sensors_yaml(tmp_path: Path) -> None:
    folder = write_folder(make_content(frames=1), tmp_path / "room")
    device = import_calibration(folder / "mav0")
    again = read_calibration(write_calibration(device, tmp_path / "sensors.yaml"))
    assert (again.imu_id, again.rig_id) == (device.imu_id, device.rig_id)
    np.testing.assert_allclose(again.T_I_C, device.T_I_C, atol=1e-15)
    with pytest.raises(UserError, match="belongs to a camera chain of kalibr"):
        read_calibration(tmp_path / "sensors.yaml", tmp_path / "imu.yaml")
    twice = dict(device.sensors.sensors)
    twice["f" * 32] = dataclasses.replace(twice[device.imu_id], id="f" * 32)
    text = write_sensors(dataclasses.replace(device.sensors, sensors=twice))
    (tmp_path / "two.yaml").write_text(text)
    with pytest.raises(UserError, match="choose one by --selected_imu_sensor_id=ID"):
        read_calibration(tmp_path / "two.yaml")


def test_of_several_rigs_and_imus_the_chosen_ones_are_used(tmp_path: Path) -> None:
    folder = write_folder(make_content(frames=1), tmp_path / "room")
    device = import_calibration(folder / "mav0")
    sensors, mounts = dict(device.sensors.sensors), dict(device.sensors.extrinsics)
    for old, new in ((device.imu_id, "f" * 32), (device.rig_id, "fe" * 16)):
        sensors[new] = dataclasses.replace(sensors[old], id=new)
        mounts[new] = mounts[old]
    several = dataclasses.replace(device.sensors, sensors=sensors, extrinsics=mounts)

    def chosen(ncamera: str, imu: str) -> RecordedSensors:
        return device_of(several, "two.yaml", DeviceOptions(ncamera, imu))

    both = chosen("FE", "ff")
    assert (both.rig_id, both.imu_id) == ("fe" * 16, "f" * 32)
    first = chosen(device.rig_id, device.imu_id)
    assert (first.rig_id, first.imu_id) == (device.rig_id, device.imu_id)
    np.testing.assert_allclose(first.T_I_C, device.T_I_C, atol=1e-15)
    for ncamera, imu, message in (
        ("", "ff", f"two.yaml: camera rigs are {device.rig_id}, .*: choose one by --selected_nc"),
        ("fe", "", "two.yaml: IMUs are .*: choose one by --selected_imu_sensor_id=ID"),
        ("fe", "123z", "--selected_imu_sensor_id=123z: two.yaml: IMUs are .*, and none of them"),
        ("fe", device.rig_id, "and none of them begins so"),
    ):
        with pytest.raises(UserError, match=message):
            chosen(ncamera, imu)
    cameras_alone = dataclasses.replace(
        device.sensors, sensors={device.rig_id: sensors[device.rig_id]}
    )
    assert device_of(cameras_alone, "a").imu_id == ""
    with pytest.raises(UserError, match="IMUs are none, and none of them begins so"):
        device_of(cameras_alone, "a", DeviceOptions(imu_sensor_id="f"))
    imu_alone = dataclasses.replace(device.sensors, sensors={device.imu_id: sensors[device.imu_id]})
    with pytest.raises(UserError, match="a has no camera rig: give a calibration with cameras"):
        device_of(imu_alone, "a")


def test_sensors_are_chosen_of_a_sensors_yaml_only(tmp_path: Path) -> None:
    folder = write_folder(make_content(frames=1), tmp_path / "room")
    chosen = DeviceOptions(imu_sensor_id="ab")
    with pytest.raises(UserError, match=r"_imu_sensor_id=ab needs a sensors\.yaml: give"):
        open_recording(folder, SourceOptions(device=chosen))
    with pytest.raises(UserError, match=r"needs a sensors\.yaml: .*mav0 is none"):
        import_calibration(folder / "mav0", chosen=chosen)


def test_tum_vi_folder_with_calibration_beside_it(tmp_path: Path) -> None:
    folder = write_folder(make_content(frames=1), tmp_path / "room1")
    for path in folder.rglob("sensor.yaml"):
        path.unlink()
    (folder / "dso").mkdir()
    source = shared_data("tumvi_imu")
    for name, target in (("imucam_chain", "camchain"), ("imu_chain", "imu_config")):
        text = (source / f"kalibr_{name}.yaml").read_text()
        (folder / "dso" / f"{target}.yaml").write_text(text)
    device = import_calibration(folder / "mav0")
    assert [camera.distortion for camera in device.cameras] == [Distortion.EQUIDISTANT] * 2
    assert device.imu is not None
    assert device.imu.acc_noise_density == 0.0028


CHAIN = CAMCHAIN.split("cam1:", maxsplit=1)[0]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "T_cam_imu",
            "T_x",
            r"cam0: key 'T_cam_imu' is missing: calibrate cameras and IMU together",
        ),
        ("radtan", "ftheta", "cam0: key 'distortion_model': 'ftheta' is not supported"),
        ("[400.0", "[-400.0", "must be positive"),
        ("update_rate: 200.0", "time_offset: 0.01", "key 'time_offset' of the only IMU must be 0"),
        ("gyroscope_noise_density", "noise", "key 'gyroscope_noise_density' is missing"),
        (
            "update_rate: 200.0",
            "Tg: [[0.1, 0, 0], [0, 0, 0], [0, 0, 0]]",
            "sensitivity to acceleration is not modelled",
        ),
        (
            "update_rate: 200.0",
            "Tw: [[0, 0, 0], [0, 1, 0], [0, 0, 1]]",
            "do not form a valid matrix",
        ),
    ],
)
def test_wrong_kalibr_files(tmp_path: Path, old: str, new: str, message: str) -> None:
    chain, imu = tmp_path / "camchain.yaml", tmp_path / "imu.yaml"
    assert old in CHAIN + IMU
    chain.write_text(CHAIN.replace(old, new))
    imu.write_text(IMU.replace(old, new))
    with pytest.raises(MapError, match=message) as caught:
        read_calibration(chain, imu)
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)


def test_kalibr_without_imu_file_has_the_first_camera_as_body(tmp_path: Path) -> None:
    chain = tmp_path / "camchain.yaml"
    chain.write_text(CHAIN.replace("T_cam_imu", "T_unknown"))
    device = read_calibration(chain)
    assert device.imu is None
    np.testing.assert_array_equal(device.T_I_C, se3.identity(1))
    with pytest.raises(MaplabError, match="cannot read"):
        read_calibration(tmp_path / "absent.yaml")
