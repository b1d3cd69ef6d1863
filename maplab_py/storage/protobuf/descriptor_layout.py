"""The two layouts of a frame's descriptors in the map format.

- Legacy, of maps before 2021: the bare bytes, keypoint by keypoint. All descriptors of a frame
  are binary and have the same size.
- Blocks, of maplab 2.2: uint64 number of blocks; of each block uint32 rows (numbers per
  descriptor), columns (keypoints), depth (0 = uint8, 5 = float32) and channels (1), then its bytes,
  keypoint by keypoint. All numbers are little-endian. `descriptor_types` of the frame has the
  feature type of each block.
"""

import struct
from collections.abc import Sequence
from typing import Literal

import numpy as np

from maplab_py.array_types import U8
from maplab_py.errors import MapError, UserError
from maplab_py.vimap import DescriptorBlock, DescriptorDepth, FeatureType, VIMap, is_valid, to_hex
from maplab_py.vimap.table import object_column
from maplab_py.vimap.tables import DescriptorLayout

LayoutChoice = Literal["as_loaded", "2.2", "legacy"]
"""Layout in which descriptors are saved."""

Blocks = tuple[DescriptorBlock, ...]

_COUNT = struct.Struct("<Q")
_HEADER = struct.Struct("<4I")
_BYTES_OF_DEPTH = {int(DescriptorDepth.UINT8): 1, int(DescriptorDepth.FLOAT32): 4}
_MAX_SIZE = 1 << 14
"""Maximum size of a descriptor in bytes: 4096 floats."""
_HEADER_EVIDENCE = 3
"""Data are damaged blocks, not legacy, if at least this many of five header fields are plausible."""


def read_blocks(
    data: bytes, types: Sequence[int], keypoints: int
) -> tuple[DescriptorLayout, Blocks | None]:
    """Detect the layout of a frame's descriptors and read its block headers.

    Only the headers are read. Data that parse completely as blocks have the block layout. Other
    data have the legacy layout if their size is a multiple of the keypoint count, the frame has
    no descriptor types, and the first bytes do not look like a header.

    Args:
        data: The bytes; empty = the frame has no descriptors.
        types: Feature types of the frame's blocks.
        keypoints: Number of the frame's keypoints.

    Raises:
        MapError: Neither layout fits; the text says why and does not name the frame.
    """
    try:
        blocks = _parsed(data, types, keypoints) if data else None
    except MapError as error:
        if types or _looks_like_header(data, keypoints):
            raise
        if not keypoints or len(data) % keypoints:
            text = f"the size of descriptors does not fit {keypoints} keypoints"
            raise MapError(text) from error
        size = len(data) // keypoints
        _check_size(size, "descriptors")
        return DescriptorLayout.LEGACY, (DescriptorBlock(keypoints, size),)
    if types and not data:
        raise MapError(f"{len(types)} descriptor types, but no descriptors")
    return DescriptorLayout.BLOCKS, blocks


def unpack(data: bytes, layout: int, blocks: Blocks, descriptor: U8) -> None:
    """Copy descriptors into the rows (keypoints, widest) of the frame's keypoints."""
    has_headers = layout == DescriptorLayout.BLOCKS
    place, row = _COUNT.size if has_headers else 0, 0
    for block in blocks:
        place += _HEADER.size if has_headers else 0
        total = block.keypoints * block.size
        if total:
            content = np.frombuffer(data, dtype=np.uint8, count=total, offset=place)
            rows = slice(row, row + block.keypoints)
            descriptor[rows, : block.size] = content.reshape(block.keypoints, block.size)
        place += total
        row += block.keypoints


def pack(layout: int, blocks: Blocks, descriptor: U8) -> bytes:
    """Return the bytes of the descriptors (keypoints, widest) of a frame's blocks."""
    has_headers = layout == DescriptorLayout.BLOCKS
    parts, row = [_COUNT.pack(len(blocks))] if has_headers else [], 0
    for block in blocks:
        if has_headers:
            numbers = block.size // _BYTES_OF_DEPTH[block.depth]
            parts.append(_HEADER.pack(numbers, block.keypoints, block.depth, 1))
        parts.append(descriptor[row : row + block.keypoints, : block.size].tobytes())
        row += block.keypoints
    return b"".join(parts)


def with_layout(vi_map: VIMap, choice: LayoutChoice) -> VIMap:
    """Return the map with the layout in which its frames are to be saved.

    With "2.2", frames without blocks get an empty list, because maplab's reader expects a list
    for every set frame.

    Raises:
        UserError: "legacy" is asked for and a frame has several types or other than binary ones.
    """
    if choice == "as_loaded":
        return vi_map
    frames = vi_map.frames
    layout = DescriptorLayout.LEGACY if choice == "legacy" else DescriptorLayout.BLOCKS
    blocks = list(frames.descriptor_blocks)
    if layout == DescriptorLayout.LEGACY:
        for row, frame_blocks in enumerate(blocks):
            filled = tuple(block for block in frame_blocks or () if block.keypoints)
            if len(filled) > 1 or not all(block.is_binary for block in filled):
                raise UserError(
                    f"frame {to_hex(frames.id[row])} has descriptors of several types or other "
                    "than binary ones, which the legacy layout cannot hold: use "
                    "--descriptor_layout=2.2"
                )
            blocks[row] = filled or None
    else:
        is_set = is_valid(frames.id).tolist()
        blocks = [
            () if frame_blocks is None and known else frame_blocks
            for frame_blocks, known in zip(blocks, is_set, strict=True)
        ]
    return vi_map.replace(
        frames=frames.replace(
            descriptor_layout=np.full(len(frames), int(layout)),
            descriptor_blocks=object_column(blocks),
        )
    )


def _parsed(data: bytes, types: Sequence[int], keypoints: int) -> Blocks:
    if len(data) < _COUNT.size:
        raise MapError(f"{len(data)} bytes are too short for descriptor blocks")
    (count,) = _COUNT.unpack_from(data)
    if count > (len(data) - _COUNT.size) // _HEADER.size:
        raise MapError(f"{count} descriptor blocks do not fit into {len(data)} bytes")
    if types and len(types) != count:
        raise MapError(f"{len(types)} descriptor types for {count} descriptor blocks")
    blocks, place = [], _COUNT.size
    for index in range(count):
        what = f"descriptor block {index}"
        if len(data) - place < _HEADER.size:
            raise MapError(f"{what} starts after the end of the data")
        numbers, columns, depth, channels = _HEADER.unpack_from(data, place)
        if depth not in _BYTES_OF_DEPTH:
            raise MapError(f"{what} has depth {depth}, which is neither uint8 (0) nor float32 (5)")
        if channels != 1:
            raise MapError(f"{what} has {channels} channels instead of 1")
        size = numbers * _BYTES_OF_DEPTH[depth]
        _check_size(size, what)
        if columns and not size:
            raise MapError(f"{what} has descriptors of no bytes")
        place += _HEADER.size + columns * size
        if place > len(data):
            raise MapError(f"{what} ends after the end of the data")
        if not types and depth != DescriptorDepth.UINT8:
            raise MapError(f"{what} holds floats, but the frame does not say of which type")
        kind = types[index] if types else FeatureType.BINARY
        blocks.append(DescriptorBlock(columns, size, depth, int(kind)))
    described = sum(block.keypoints for block in blocks)
    if place != len(data):
        raise MapError(f"{len(data) - place} bytes follow the last descriptor block")
    if blocks and described != keypoints:
        raise MapError(f"{described} descriptors for {keypoints} keypoints")
    return tuple(blocks)


def _check_size(size: int, what: str) -> None:
    if size > _MAX_SIZE:
        raise MapError(f"{what}: {size} bytes per descriptor are more than {_MAX_SIZE}")


def _looks_like_header(data: bytes, keypoints: int) -> bool:
    """Return whether most fields of the first header are plausible."""
    if len(data) < _COUNT.size + _HEADER.size:
        return False
    (count,) = _COUNT.unpack_from(data)
    numbers, columns, depth, channels = _HEADER.unpack_from(data, _COUNT.size)
    evidence = (
        0 < count < 256,
        0 < numbers <= _MAX_SIZE,
        0 < columns <= keypoints,
        depth in _BYTES_OF_DEPTH,
        channels == 1,
    )
    return bool(sum(evidence) >= _HEADER_EVIDENCE)
