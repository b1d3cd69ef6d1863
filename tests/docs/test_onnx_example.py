"""The example plugin that runs a network, installed and run with one that the test writes."""

import json
from pathlib import Path

import pytest

from maplab_py.storage.native import save_map
from maplab_py.vimap import VIMap
from tests.algorithms.image_features.test_extraction import room, with_images
from tests.docs.test_example_plugin import install_example, run_maplab
from tests.support import data, small_network

EXAMPLE = data.REPOSITORY / "docs" / "examples" / "maplab_onnx"
__all__ = ["room", "with_images"]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("onnx", reason="the network is written by onnx")
    pytest.importorskip("onnxruntime", reason="the extra [learned] is not installed")
    return install_example(EXAMPLE, tmp_path_factory)


@pytest.fixture(scope="module")
def map_folder(with_images: VIMap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("map") / "room"
    save_map(with_images, folder)
    return folder


def test_a_network_gives_features_and_landmarks(
    installed: Path, map_folder: Path, tmp_path: Path
) -> None:
    small_network.write_network(tmp_path / "net.onnx")
    line = (
        f"load {map_folder}; extract_features --feature_type=plugin:onnx "
        f"--feature_model={tmp_path / 'net.onnx'} --max_features=120; "
        "track_features --feature_type=plugin:onnx --track_max_descriptor_distance=0.5; itl; "
        "check_map_consistency"
    )
    done = run_maplab(installed, "--json", "--discard", "-c", line)
    assert done.returncode == 0, done.stderr
    reports = [json.loads(text)["report"] for text in done.stdout.splitlines()]
    extraction, tracks, landmarks = reports[1:4]
    assert extraction["feature_type"] == "SuperPoint"
    assert extraction["descriptor_bytes"] == 4 * small_network.NUMBERS
    assert extraction["median_per_image"] == min(120, small_network.FEATURES)
    assert tracks["tracks"] > 30
    assert landmarks["landmarks_added"] > 10


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ("", "needs a network: give --feature_model=FILE.onnx"),
        ("nowhere.onnx", "there is no such file"),
        ("text.onnx", "onnxruntime cannot open it as a network"),
        ("part.onnx", "the network has no output descriptors; it has keypoints, scores"),
    ],
)
def test_files_that_are_no_such_network(
    installed: Path, map_folder: Path, tmp_path: Path, model: str, message: str
) -> None:
    (tmp_path / "text.onnx").write_text("no network")
    small_network.write_network(tmp_path / "part.onnx", outputs=("keypoints", "scores"))
    flag = f"--feature_model={tmp_path / model}" if model else ""
    line = f"load {map_folder}; extract_features --feature_type=plugin:onnx {flag}"
    done = run_maplab(installed, "-c", line)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr
