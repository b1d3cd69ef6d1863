"""Extra protobuf fields that algorithms store in the `unknown` bytes of a row.

A map file holds them as length-delimited protobuf fields: programs that do not know them skip them.
"""

import zlib

from maplab_py.errors import MapError
from maplab_py.input_files import DEFAULT_MAX_BYTES, TooLarge, inflate, inflated_size

LOOP_RECORD = 1000
"""Field number of the loop-closure record in the mission message, above all schema fields."""
PACKED = b"LC1"
"""Header of a packed field; a zlib stream follows."""
RECORD_SHARE = 4
"""Maximum unpacked size of a record as a fraction of the bound; reading copies its tables."""
_ZLIB = 15
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


def read_extension(unknown: bytes, number: int) -> bytes | None:
    """Return the content of a field, None when it is not there.

    Raises:
        MapError: The bytes are not protobuf fields.
    """
    content = None
    for field, wire_type, _, begin, end in _fields(unknown):
        if field == number and wire_type == _BYTES:
            content = unknown[begin:end]
    return content


def with_extension(unknown: bytes, number: int, content: bytes | None) -> bytes:
    """Return the bytes with a field set, or removed if the content is None.

    Raises:
        MapError: The bytes are not protobuf fields.
    """
    kept = b"".join(
        unknown[first:end] for field, _, first, _, end in _fields(unknown) if field != number
    )
    if content is None:
        return kept
    return kept + _varint(number << 3 | _BYTES) + _varint(len(content)) + content


def unpacked(content: bytes, max_bytes: int = DEFAULT_MAX_BYTES) -> bytearray:
    """Return the content of a packed field.

    Raises:
        ValueError: It is damaged, of a newer version, or larger than max_bytes.
    """
    if not content.startswith(PACKED):
        raise ValueError("of a newer version")
    try:
        plain, size = inflate(content[len(PACKED) :], max_bytes, wbits=_ZLIB)
    except TooLarge as error:
        raise ValueError(f"it unpacks to {error}") from error
    except EOFError:
        raise ValueError("its data end early") from None
    except zlib.error as error:
        raise ValueError(str(error)) from error
    if size != len(content) - len(PACKED):
        raise ValueError("bytes follow its data")
    return plain


def packed_size(content: bytes, max_bytes: int) -> int:
    """Return the size of a packed field's content, at most max_bytes + 1; 0 when it is damaged."""
    try:
        return inflated_size(memoryview(content)[len(PACKED) :], max_bytes, wbits=_ZLIB)
    except (EOFError, zlib.error):
        return 0


def _fields(unknown: bytes) -> list[tuple[int, int, int, int, int]]:
    """Return number, wire type, first byte, begin and end of the content of every field."""
    fields, place = [], 0
    try:
        while place < len(unknown):
            first = place
            tag, place = _read_varint(unknown, place)
            wire_type, begin = tag & 7, place
            if wire_type == _VARINT:
                _, place = _read_varint(unknown, place)
            elif wire_type == _BYTES:
                size, begin = _read_varint(unknown, place)
                place = begin + size
            else:
                place += {_FIXED64: 8, _FIXED32: 4}[wire_type]
            if place > len(unknown):
                raise IndexError
            fields.append((tag >> 3, wire_type, first, begin, place))
    except (IndexError, KeyError):
        raise MapError("the extra fields of an entry are damaged") from None
    return fields


def _read_varint(data: bytes, place: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[place]
        place += 1
        value |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80:
            return value, place


def _varint(value: int) -> bytes:
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)
