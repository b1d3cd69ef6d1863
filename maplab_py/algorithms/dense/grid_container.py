"""The container of grids in resource files, described in docs/map_format.md.

A line of text names the format, a line of JSON has the settings and the number of rows of each array;
the arrays follow, little-endian, in the order of the header.
"""

from __future__ import annotations

import dataclasses
import json
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.errors import MapError

_MAX_HEADER_BYTES = 100_000


@dataclasses.dataclass(frozen=True)
class GridFormat:
    """One kind of grid."""

    name: str  # in the first line, with its version
    noun: str  # in messages
    command: str  # that makes one

    @property
    def first_line(self) -> bytes:
        """Return the line that a file begins with."""
        return f"maplab-py {self.name}\n".encode()


def encode_arrays(
    kind: GridFormat, header: dict[str, Any], arrays: Sequence[NDArray[Any]]
) -> bytes:
    """Return the content of a file; equal arguments give equal bytes."""
    body = b"".join(
        np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes() for array in arrays
    )
    header = {**header, "crc32": zlib.crc32(body)}
    return kind.first_line + json.dumps(header, sort_keys=True).encode() + b"\n" + body


class GridContent:
    """The content of a file."""

    def __init__(self, kind: GridFormat, data: bytes, source: str) -> None:
        """Read the header and check the arrays.

        Raises:
            MapError: It is no such file, or damaged; names the source.
        """
        self._source, self._kind = source, kind
        start = len(kind.first_line)
        if not data.startswith(kind.first_line):
            raise MapError(
                f"{source}: it is no {kind.noun} of maplab-py (C++ maplab's are not read): make it "
                f"again by {kind.command} --overwrite"
            )
        end = data.find(b"\n", start, _MAX_HEADER_BYTES)
        try:
            self._header = json.loads(data[start:end])
            checksum = self.count("crc32")
        except (ValueError, TypeError, RecursionError):
            raise self._damaged(f"the header of the {kind.noun} is damaged") from None
        self._body = memoryview(data)[end + 1 :]
        if zlib.crc32(self._body) != checksum:
            raise self._damaged(f"the {kind.noun} is damaged or ends early")

    def count(self, name: str) -> int:
        """Return a whole number of the header, 0 or greater; see `value`."""
        number = self.value(name)
        if not isinstance(number, int) or number < 0:
            raise self._damaged(f"the header of the {self._kind.noun} is damaged")
        return number

    def value(self, name: str) -> float:
        """Return a number of the header.

        Raises:
            MapError: There is none of this name.
        """
        number = self._header.get(name) if isinstance(self._header, dict) else None
        if not isinstance(number, int | float):
            raise self._damaged(f"the header of the {self._kind.noun} is damaged")
        return number

    def array(self, kind: str, shape: tuple[int, ...]) -> NDArray[Any]:
        """Return the next array, of a numpy type such as "<f4".

        Raises:
            MapError: The file ends before.
        """
        size = int(np.prod(shape, dtype=object)) * np.dtype(kind).itemsize
        if size > len(self._body):
            raise self._damaged(f"the {self._kind.noun} ends early")
        part, self._body = self._body[:size], self._body[size:]
        return np.frombuffer(part, dtype=kind).reshape(shape)

    def _damaged(self, what: str) -> MapError:
        return MapError(f"{self._source}: {what}; make it again by {self._kind.command}")
