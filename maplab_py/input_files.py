"""Files that commands read: bounded in size before anything is allocated for them.

A file of some megabytes can ask for thousands of times its size in memory, because it is compressed
or because its parts become objects. Everything that is read from outside passes through here.
"""

from __future__ import annotations

import os
import re
import stat
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.errors import MapError, UserError
from maplab_py.options import Options, option

if TYPE_CHECKING:
    import zipfile

DEFAULT_MAX_MEGABYTES = 2000
DEFAULT_MAX_BYTES = DEFAULT_MAX_MEGABYTES * 1_000_000
SCRIPT_MAX_BYTES = 16_000_000
"""Of files that people write: scripts, flag files, aliases."""
LARGEST = 1e100
"""Numbers beyond it, whose squares overflow, are no measurements: readers of text refuse them."""
RAISE_THE_BOUND = "raise --proto_max_size_megabytes if it is really that large"
_CHUNK = 1 << 20
_UTF_16 = b"\xff\xfe", b"\xfe\xff"
_CONTROLS = re.compile(r"[\x00-\x08\x0e-\x1f\x7f-\x9f]")
_FIRST_CHUNK = 1 << 12
_ZIP_DIRECTORY_ENTRIES = 10_000


class SizeOptions(Options):
    """Bound of what is read."""

    proto_max_size_megabytes: int = option(DEFAULT_MAX_MEGABYTES, unit="MB")
    """Refuse files that unpack to more than this."""

    @property
    def max_bytes(self) -> int:
        """The bound in bytes."""
        return self.proto_max_size_megabytes * 1_000_000


class TooLarge(UserError):
    """Compressed data unpack to more than they may."""


def read_bytes(
    path: Path,
    max_bytes: int = DEFAULT_MAX_BYTES,
    *,
    remedy: str = RAISE_THE_BOUND,
    error: type[UserError] = UserError,
) -> bytes:
    """Return the content of a file.

    Args:
        path: File; pipes are read too.
        max_bytes: Largest size.
        remedy: What the user can do about a file that is too large.
        error: Raised when it is.

    Raises:
        OSError: The file cannot be read.
        UserError: It is larger than max_bytes.
    """
    with path.open("rb", buffering=0) as file:
        status = os.fstat(file.fileno())
        if stat.S_ISREG(status.st_mode) and status.st_size <= max_bytes:
            content = file.read(status.st_size)
            if len(content) == status.st_size:
                return content
            file.seek(0)
        elif stat.S_ISREG(status.st_mode):
            raise error(f"{path}: is larger than {_megabytes(max_bytes)} MB; {remedy}")
        parts, size = [], 0
        while chunk := file.read(_CHUNK):
            parts.append(chunk)
            size += len(chunk)
            if size > max_bytes:
                raise error(f"{path}: is larger than {_megabytes(max_bytes)} MB; {remedy}")
    return b"".join(parts)


def read_text(
    path: Path,
    max_bytes: int = DEFAULT_MAX_BYTES,
    *,
    remedy: str = RAISE_THE_BOUND,
    error: type[UserError] = UserError,
) -> str:
    """Return the text of a file with line ends `\\n`; see `read_bytes`.

    Raises:
        OSError: The file cannot be read.
        UnicodeDecodeError: It is not text.
        UserError: It is larger than max_bytes.
    """
    text = read_bytes(path, max_bytes, remedy=remedy, error=error).decode("utf-8")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_foreign_text(path: Path, max_bytes: int, *, remedy: str = "split it into parts") -> str:
    """Return the text of a file that another program wrote; see `decode_foreign` and `read_bytes`.

    Raises:
        MapError: The file cannot be read, is too large, or is not text.
    """
    try:
        return decode_foreign(read_bytes(path, max_bytes, remedy=remedy, error=MapError))
    except OSError as error:
        raise MapError(f"cannot read {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise MapError(f"cannot read {path}: it is not text") from error


def decode_foreign(content: bytes) -> str:
    """Return text as UTF-16 or UTF-8, with a byte order mark or without, with line ends `\\n`.

    Other encodings differ from ASCII in names and comments alone: they are read as Latin-1, for ° and µ.

    Raises:
        UnicodeDecodeError: The content is not text.
    """
    try:
        text = content.decode("utf-16" if content.startswith(_UTF_16) else "utf-8-sig")
    except UnicodeDecodeError:
        if b"\0" in content or content.startswith(_UTF_16):
            raise
        text = _CONTROLS.sub("\ufffd", content.decode("latin-1"))
    return text.replace("\r\n", "\n").replace("\r", "\n")


def inflate(data: bytes | memoryview, max_bytes: int, *, wbits: int) -> tuple[bytearray, int]:
    """Decompress one zlib or gzip stream piece by piece.

    Args:
        data: Begins with the stream; more may follow it.
        max_bytes: Largest size of the result.
        wbits: 15 for zlib, 31 for gzip.

    Returns:
        The content and the number of bytes of `data` that belong to the stream.

    Raises:
        TooLarge: The content is larger than max_bytes.
        EOFError: The stream ends early.
        zlib.error: The stream is damaged.
    """
    content = bytearray()
    for piece in _pieces(memoryview(data), wbits):
        if isinstance(piece, int):
            return content, piece
        if len(content) + len(piece) > max_bytes:
            raise TooLarge(f"more than {_megabytes(max_bytes)} MB")
        content += piece
    raise EOFError


def inflated_size(data: bytes | memoryview, max_bytes: int, *, wbits: int) -> int:
    """Return the size of what `inflate` would return, or max_bytes + 1 if it is larger.

    Raises:
        EOFError: The stream ends early.
        zlib.error: The stream is damaged.
    """
    size = 0
    for piece in _pieces(memoryview(data), wbits):
        if isinstance(piece, int):
            return size
        size += len(piece)
        if size > max_bytes:
            return max_bytes + 1
    raise EOFError


def _pieces(data: memoryview, wbits: int) -> Iterable[bytes | int]:
    """Yield the content of a stream in pieces of bounded size, at its end the stream's length."""
    unpacker = zlib.decompressobj(wbits)
    place, chunk = 0, _FIRST_CHUNK  # small at first: many streams may be small
    while place < len(data):
        packed: Any = data[place : place + chunk]
        place += len(packed)
        while packed and not unpacker.eof:
            yield unpacker.decompress(packed, _CHUNK)
            packed = unpacker.unconsumed_tail
        if unpacker.eof:
            yield place - len(unpacker.unused_data)
            return
        chunk = min(4 * chunk, _CHUNK)
    while not unpacker.eof and (piece := unpacker.decompress(b"", _CHUNK)):
        yield piece
    if unpacker.eof:
        yield place - len(unpacker.unused_data)


def read_npz(path: Path, max_bytes: int = DEFAULT_MAX_BYTES) -> dict[str, NDArray[Any]]:
    """Return all arrays of an .npz file, read-only; nothing in it is executed.

    Raises:
        OSError: The file cannot be read.
        ValueError: It is no such file, or an array in it is damaged.
        UserError: The file, or what it unpacks to, is larger than max_bytes.
    """
    import zipfile

    too_large = UserError(
        f"{path}: unpacks to more than {_megabytes(max_bytes)} MB; {RAISE_THE_BOUND}"
    )
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            if len(entries) > _ZIP_DIRECTORY_ENTRIES:
                raise ValueError(f"{len(entries)} arrays")
            if sum(entry.file_size for entry in entries) > max_bytes:
                raise too_large
            # zipfile never returns more than the announced size of an entry
            return {e.filename.removesuffix(".npy"): _array(archive, e) for e in entries}
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise ValueError(f"not an .npz file ({error or type(error).__name__})") from error


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> NDArray[Any]:
    with archive.open(entry) as file:
        version = np.lib.format.read_magic(file)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }.get(version)
        if read_header is None:
            raise ValueError(f"{entry.filename} has version {version}")
        shape, is_column_major, dtype = read_header(file)
        if dtype.hasobject:
            raise ValueError(f"{entry.filename} holds Python objects")
        data = file.read()
    count = 1
    for size in shape:
        count *= size
    if count * dtype.itemsize != len(data):
        raise ValueError(f"{entry.filename} has {len(data)} bytes for {shape} numbers")
    flat = np.frombuffer(data, dtype=dtype, count=count)
    return flat.reshape(shape, order="F" if is_column_major else "C")


def _megabytes(size: int) -> str:
    return f"{size / 1e6:g}"
