"""Upper bounds on the memory of a message, computed before it is parsed.

A parsed message takes many times its bytes: an empty entry is two bytes in the file and more than a
kilobyte as objects. Two estimates, both upper bounds: one that costs a pass over the bytes, and
one that follows the fields.
"""

import functools
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.descriptor import Descriptor, FieldDescriptor

from maplab_py.array_types import I64
from maplab_py.errors import MapError

_PER_MESSAGE = 1300
"""Memory of a message with its Python views in bytes (measured: at most 1210, a landmark)."""
_PER_ID = 160
"""Memory of an Id in bytes; its views are created in batches (measured: 120)."""
_PER_NUMBER = 60
"""Memory of a repeated number: twice 8 in the message, 8 + 24 as Python object, 8 in the array."""
_PER_BYTE = 3
"""Memory per byte of binary data: file, message and table."""
_LENGTH_DELIMITED = 2
_OPAQUE, _PACKED_VARINTS, _PACKED_8, _PACKED_4 = -1, -2, -3, -4


class MemoryBudget:
    """Memory budget of all messages of a map: twice the bound of one file."""

    def __init__(self, max_bytes: int, left: int | None = None) -> None:
        """Allow files up to `max_bytes` each, and messages of `left`, or twice that size, together."""
        self.max_bytes = max_bytes
        self._left = 2 * max_bytes if left is None else left
        self._admitted = 0  # by the latest message
        # messages that only the quick estimate was made for, at most a sixtieth of the budget
        self._quick: list[tuple[int, bytes | bytearray, Any]] = []

    def admit(self, path: Path, data: bytes | bytearray, kind: Any) -> None:
        """Subtract the memory of a message from the budget; `give_back` returns a part of it.

        Raises:
            MapError: The message exceeds the remaining budget; names the file.
        """
        needed = quick_estimate(data)
        if needed <= self._left:
            self._quick.append((needed, data, kind))
        else:  # replace the quick estimates, which may be far too large
            self._left += sum(quick - estimate(content, of) for quick, content, of in self._quick)
            self._quick.clear()
            needed = estimate(data, kind)
        if needed > self._left:
            raise self._exceeded(path)
        self._left -= needed
        self._admitted = needed

    @property
    def left(self) -> int:
        """Remaining bytes."""
        return self._left

    def keep(self, path: Path, kept_bytes: int) -> None:
        """Subtract what is kept of a message that another process has admitted.

        Raises:
            MapError: It exceeds the remaining budget; names the file.
        """
        if kept_bytes > self._left:
            raise self._exceeded(path)
        self._left -= kept_bytes

    def _exceeded(self, path: Path) -> MapError:
        return MapError(
            f"{path}: its entries need more than {2 * self.max_bytes / 1e6:g} MB of memory "
            "with those of the files before it; raise --proto_max_size_megabytes if the map "
            "is really that large"
        )

    def give_back(self, kept_bytes: int) -> None:
        """Replace what the latest message was admitted with by what is kept of it."""
        if self._quick and self._quick[-1][0] == self._admitted:
            self._quick.pop()
        self._left += self._admitted - kept_bytes
        self._admitted = kept_bytes


def quick_estimate(data: bytes | bytearray) -> int:
    """Return an upper bound of a message's memory from the number of possible field tags.

    Parts have field numbers up to 15, hence tags of one byte, or longer ones with needless zeros.
    """
    flat = np.frombuffer(data, dtype=np.uint8)
    tags = int(np.count_nonzero((flat & 0x87) == _LENGTH_DELIMITED))
    long_tags = 0
    if len(flat) > 1:
        begins = (flat[:-1] & 0x87) == (0x80 | _LENGTH_DELIMITED)
        long_tags = int(np.count_nonzero(begins & ((flat[1:] & 0x7F) == 0)))
    return _PER_MESSAGE * (tags + long_tags) + _PER_NUMBER * len(data)


def estimate(data: bytes | bytearray, kind: Descriptor) -> int:
    """Return an upper bound of the memory of a message by walking over all its fields."""
    from maplab_py.storage.protobuf.scan_kernel import count_parts

    layout, per_message = _layout(kind)
    content = memoryview(data).toreadonly()  # one kernel for bytes and bytearrays
    messages, numbers = count_parts(np.frombuffer(content, dtype=np.uint8), layout)
    return int(messages @ per_message) + _PER_NUMBER * int(numbers) + _PER_BYTE * len(data)


@functools.cache
def _layout(root: Descriptor) -> tuple[I64, I64]:
    """Return the content (types, 16) of each field and the memory (types,) of each message type."""
    kinds = [root]
    rows: list[list[int]] = []
    for kind in kinds:  # grows
        row = [_OPAQUE] * 16
        for field in kind.fields:
            if field.number < 16:
                row[field.number] = _content(field, kinds)
        rows.append(row)
    sizes = [_PER_ID if kind.name == "Id" else _PER_MESSAGE for kind in kinds]
    return np.array(rows, dtype=np.int64), np.array(sizes, dtype=np.int64)


def _content(field: Any, kinds: list[Descriptor]) -> int:
    if field.message_type is not None:
        if field.message_type not in kinds:
            kinds.append(field.message_type)
        return kinds.index(field.message_type)
    if field.type in (FieldDescriptor.TYPE_BYTES, FieldDescriptor.TYPE_STRING):
        return _OPAQUE
    if field.type == FieldDescriptor.TYPE_DOUBLE:
        return _PACKED_8
    return _PACKED_4 if field.type == FieldDescriptor.TYPE_FLOAT else _PACKED_VARINTS
