"""Writes and reads the descriptors of map files by hand, to compare the program with.

Nothing of the program is used but the generated messages.
"""

import gzip
import shutil
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from maplab_py.storage import maplab_map_pb2 as pb

BINARY, SUPERPOINT, SIFT = 0, 1, 3
ONE_TYPE = ((BINARY, 0, 48),)
THREE_TYPES = ((BINARY, 0, 48), (SUPERPOINT, 5, 256), (SIFT, 5, 128))
"""Feature type, OpenCV's depth and numbers per descriptor."""

Frame = tuple[tuple[int, ...], tuple[int, ...], bytes]
"""Id, feature types of the blocks, and bytes."""


def vertex_files(folder: Path) -> list[Path]:
    """Return the files of a map folder that hold vertices."""
    return sorted((folder / "vi_map").glob("vertices*"))


def read(path: Path) -> pb.VIMap:
    """Parse a file of a map."""
    return pb.VIMap.FromString(gzip.decompress(path.read_bytes()))


def write(path: Path, message: pb.VIMap) -> None:
    """Write a file of a map."""
    path.write_bytes(gzip.compress(message.SerializeToString(), 1))


def frames(folder: Path) -> Iterator[Frame]:
    """Yield what the files of a map say of the descriptors of each frame."""
    for path in vertex_files(folder):
        for vertex in read(path).vertices:
            for frame in vertex.nframe.frames:
                yield tuple(frame.id.words), tuple(frame.descriptor_types), frame.descriptors


def described(folder: Path) -> dict[tuple[int, ...], tuple[tuple[int, ...], bytes]]:
    """Return types and bytes of each frame's descriptors by the frame's id."""
    return {name: (types, data) for name, types, data in frames(folder)}


def reencode(
    source: Path,
    target: Path,
    kinds: tuple[tuple[int, int, int], ...],
    *,
    marked: bool = False,
    with_types: bool = True,
) -> Path:
    """Copy a map with bare descriptors of 48 bytes and write them as blocks.

    The keypoints of each frame are cut into as many parts as there are kinds. Binary descriptors
    stay what they are; others are random bits, NaN and infinity among them.

    Args:
        source: Map folder.
        target: Map folder to make.
        kinds: Feature type, depth and numbers per descriptor of the parts.
        marked: Give every keypoint a 3D position and a time offset that its pixel determines.
        with_types: Write `descriptor_types`.
    """
    shutil.copytree(source, target)
    for path in [target, *target.rglob("*")]:
        path.chmod(0o755)
    for path in vertex_files(target):
        message = read(path)
        for vertex in message.vertices:
            for frame in vertex.nframe.frames:
                _reencode(frame, kinds, with_types)
                if marked:
                    uv = np.array(frame.keypoints_px).reshape(-1, 2)
                    frame.positions_3d.extend(marks_3d(uv).reshape(-1).tolist())
                    frame.time_offsets_ns.extend(marks_ns(uv).tolist())
        write(path, message)
    return target


def marks_3d(uv: np.ndarray) -> np.ndarray:
    """Return the 3D positions (N, 3) of marked keypoints."""
    return np.stack([uv[:, 0], uv[:, 1], uv[:, 0] * uv[:, 1]], axis=1)


def marks_ns(uv: np.ndarray) -> np.ndarray:
    """Return the time offsets (N,) of marked keypoints."""
    return np.round(1000.0 * (uv[:, 0] - uv[:, 1])).astype(np.int32)


def _reencode(
    frame: pb.VisualFrame,
    kinds: tuple[tuple[int, int, int], ...],
    with_types: bool,
) -> None:
    rng = np.random.default_rng(list(frame.id.words))  # submaps share frames
    count = len(frame.keypoints_px) // 2
    bare = frame.descriptors
    assert len(bare) == 48 * count
    cuts = [count * part // len(kinds) for part in range(len(kinds) + 1)]
    data = struct.pack("<Q", len(kinds))
    for (kind, depth, numbers), begin, end in zip(kinds, cuts, cuts[1:], strict=False):
        data += struct.pack("<IIII", numbers, end - begin, depth, 1)
        if kind == BINARY:
            data += bare[48 * begin : 48 * end]
        else:
            data += rng.bytes((end - begin) * numbers * {0: 1, 5: 4}[depth])
    frame.descriptors = data
    if with_types:
        frame.descriptor_types.extend(kind for kind, _, _ in kinds)


def decode(data: bytes, types: tuple[int, ...]) -> list[tuple[int, bytes]]:
    """Return feature type and bytes of every keypoint's descriptor."""
    found = []
    (count,) = struct.unpack_from("<Q", data)
    place = 8
    for index in range(count):
        numbers, columns, depth, channels = struct.unpack_from("<IIII", data, place)
        assert channels == 1
        size = numbers * {0: 1, 5: 4}[depth]
        place += 16
        for _ in range(columns):
            found.append((types[index], data[place : place + size]))
            place += size
    assert place == len(data)
    return found
