"""The commands that read files of other programs, through the session and the console."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplab_py.algorithms.self_calibration.device import device_of
from maplab_py.console.commands.registry import load_registry
from maplab_py.console.session.session import Session
from maplab_py.errors import UserError
from maplab_py.sensors import Distortion
from maplab_py.sensors.sensors_yaml import read_sensors
from tests.algorithms.self_calibration.scenes import scene_map
from tests.interop.test_calibration_import import CAMCHAIN, IMU, basalt, written


def test_a_calibration_is_looked_at_and_written(tmp_path: Path) -> None:
    with Session(load_registry()) as session:
        report: Any = session.run("import_calibration", calibration_file=basalt(tmp_path))
        assert (report.format, len(report.cameras), report.has_imu) == ("Basalt", 2, True)
        assert "--apply" in report.advice
        chain, imu = written(tmp_path, "chain.yaml", CAMCHAIN), written(tmp_path, "imu.yaml", IMU)
        sensors = tmp_path / "sensors.yaml"
        flags = {"calibration_file": chain, "imu_calibration_file": imu, "sensors_file": sensors}
        report = session.run("import_calibration", **flags)
        assert report.cameras[0].time_shift_s == pytest.approx(0.004)
        assert len(read_sensors(sensors).sensors) == 2
        with pytest.raises(UserError, match=r"sensors\.yaml"):
            session.run("import_calibration", **flags)
        session.run("import_calibration", **flags, overwrite=True)


def test_a_calibration_is_applied_and_taken_back(tmp_path: Path) -> None:
    vi_map = scene_map(distortion=Distortion.RADTAN)
    device = device_of(vi_map)
    with Session(load_registry()) as session:
        session.maps.add("walk", vi_map)
        folder = tmp_path / "kalibr"
        session.run("export_calibration", folder=folder, format="kalibr")
        chain = folder / "camchain-imucam.yaml"
        before = vi_map.sensors.camera_rig(device.rig).cameras[0].intrinsics
        text = chain.read_text().replace(f"{before[0]}", f"{before[0] + 7.0}")
        chain.write_text(text)
        flags = {"calibration_file": chain, "imu_calibration_file": folder / "imu.yaml"}
        report: Any = session.run("import_calibration", **flags, apply=True)
        changed = {row.parameter: row for row in report.changes if abs(row.difference) > 1e-9}
        assert list(changed) == ["camera focal length u"]
        after = session.vi_map.sensors.camera_rig(device.rig).cameras[0].intrinsics
        np.testing.assert_allclose(after - before, [7.0, 0.0, 0.0, 0.0], atol=1e-9)
        session.run("undo")
        assert session.vi_map is vi_map or session.vi_map.sensors is vi_map.sensors
        chain.write_text(text[: len(text) // 2])
        with pytest.raises(UserError, match="camchain-imucam"):
            session.run("import_calibration", **flags, apply=True)
        assert session.vi_map.sensors is vi_map.sensors
