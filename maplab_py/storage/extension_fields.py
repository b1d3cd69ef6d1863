"""Extra protobuf fields that algorithms store in the `unknown` bytes of a row.

A map file holds them as length-delimited protobuf fields: programs that do not know them skip them.
"""

import functools
import zlib
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError

from maplab_py.errors import MapError
from maplab_py.input_files import DEFAULT_MAX_BYTES, TooLarge, inflate, inflated_size

LOOP_RECORD = 1000
"""Field number of the loop-closure record in the mission message, above all schema fields."""
PACKED = b"LC1"
"""Header of a packed field; a zlib stream follows."""
RECORD_SHARE = 4
"""Maximum unpacked size of a record as a fraction of the bound; reading copies its tables."""
_ZLIB = 15


@functools.cache
def _message_type(number: int) -> Any:
    """Return the type of messages that know one field of bytes by its number; they keep the others."""
    kind = f"Extension{number}"
    file = descriptor_pb2.FileDescriptorProto(name=f"{kind}.proto")
    field = descriptor_pb2.FieldDescriptorProto
    file.message_type.add(name=kind).field.add(
        name="content", number=number, type=field.TYPE_BYTES, label=field.LABEL_OPTIONAL
    )
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(kind))


def _parsed(unknown: bytes, number: int) -> Any:
    try:
        return _message_type(number).FromString(unknown)
    except DecodeError:
        raise MapError("the extra fields of an entry are damaged") from None


def read_extension(unknown: bytes, number: int) -> bytes | None:
    """Return the content of a field, None when it is not there.

    Raises:
        MapError: The bytes are not protobuf fields.
    """
    message = _parsed(unknown, number)
    return message.content if message.HasField("content") else None


def with_extension(unknown: bytes, number: int, content: bytes | None) -> bytes:
    """Return the bytes with a field set, or removed if the content is None.

    Raises:
        MapError: The bytes are not protobuf fields.
    """
    message = _parsed(unknown, number)
    message.ClearField("content")
    return bytes(
        message.SerializeToString() + _message_type(number)(content=content).SerializeToString()
    )


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
