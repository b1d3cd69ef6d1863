"""Connection headers and messages of TCPROS. Source: wiki.ros.org, "ROS/TCPROS", "ROS/Connection Header"."""

from __future__ import annotations

import socket
import struct

from maplab_py.errors import MaplabError
from maplab_py.interop.live.transport import MAX_MESSAGE_BYTES

_MAX_HEADER_BYTES = 1_000_000  # with the definition of the message


class ConnectionProblem(MaplabError):
    """A peer says something that is not TCPROS, or refuses."""


def header_bytes(fields: dict[str, str]) -> bytes:
    """Return a connection header."""
    lines = [f"{key}={value}".encode() for key, value in fields.items()]
    content = b"".join(struct.pack("<I", len(line)) + line for line in lines)
    return struct.pack("<I", len(content)) + content


def parse_header(content: bytes) -> dict[str, str]:
    """Return the fields of a connection header, without its length.

    Raises:
        ConnectionProblem: It is damaged.
    """
    fields, at = {}, 0
    while at < len(content):
        if at + 4 > len(content):
            raise ConnectionProblem("the connection header is damaged")
        size = struct.unpack_from("<I", content, at)[0]
        line = content[at + 4 : at + 4 + size]
        key, separator, value = line.partition(b"=")
        if len(line) < size or not separator:
            raise ConnectionProblem("the connection header is damaged")
        fields[key.decode(errors="replace")] = value.decode(errors="replace")
        at += 4 + size
    return fields


def receive_header(connection: socket.socket) -> dict[str, str]:
    """Receive a connection header.

    Raises:
        ConnectionProblem: It is damaged or too large, or the connection ends.
        OSError: The connection fails.
    """
    return parse_header(bytes(_receive_block(connection, _MAX_HEADER_BYTES, "connection header")))


def receive_message(connection: socket.socket) -> bytes:
    """Receive a message.

    Raises:
        ConnectionProblem: It is too large, or the connection ends.
        OSError: The connection fails.
    """
    return bytes(_receive_block(connection, MAX_MESSAGE_BYTES, "message"))


def _receive_block(connection: socket.socket, limit: int, what: str) -> bytearray:
    size = struct.unpack("<I", _receive(connection, 4))[0]
    if size > limit:
        raise ConnectionProblem(f"a {what} of {size:,} bytes is refused (at most {limit:,})")
    return _receive(connection, size)


def _receive(connection: socket.socket, size: int) -> bytearray:
    data = bytearray(size)
    view, at = memoryview(data), 0
    while at < size:
        count = connection.recv_into(view[at:])
        if not count:
            raise ConnectionProblem("the publisher has closed the connection")
        at += count
    return data
