"""The third and the fourth line of the README on three recorded maps and walks."""

import json
import re
from pathlib import Path

import pytest

from maplab_py.storage.native import load_map
from tests.e2e.support import run_program
from tests.support.data import REPOSITORY, shared_data

pytestmark = pytest.mark.slow


def recipe(folder: str) -> str:
    """Return the chain of the README for another map."""
    found = re.search(
        r'^maplab -c "(load mh_01;[^"]*)"', (REPOSITORY / "README.md").read_text(), re.M
    )
    assert found is not None
    return found[1].replace("mh_01", folder, 1)


@pytest.mark.parametrize(
    "before",
    [
        "load {data}/maplab_maps/tango_handheld; save map",
        "load_merge_all_submaps --maps_folder={data}/maplab_maps/euroc_v1_01; save map",
        "rovioli {data}/handheld_room_70s --save_map_folder=map"
        " --sensor_calibration_file={data}/handheld_room_70s/camchain-imucam.yaml"
        " --imu_calibration_file={data}/handheld_room_70s/imu.yaml",
    ],
    ids=["Tango", "V1_01", "handheld room"],
)
def test_the_recipe_ends_well(before: str, tmp_path: Path) -> None:
    for text in (before.format(data=shared_data()), recipe("map")):
        done = run_program(tmp_path, "-c", text, "--json", seconds=3600.0)
        assert done.returncode == 0, done.stderr
    reports = [json.loads(line)["report"] for line in done.stdout.splitlines()]
    errors_px = [
        r["mean_reprojection_after_px"] for r in reports if "mean_reprojection_after_px" in r
    ]
    assert len(errors_px) == 2
    assert max(errors_px) < 1.0
    assert len(load_map(tmp_path / "map")[0].missions) == 1
