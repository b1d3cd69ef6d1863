"""The files of a map folder as bytes: which there are, unpacked, with bounds."""

from __future__ import annotations

import zlib
from pathlib import Path, PurePosixPath

from google.protobuf import text_format
from google.protobuf.message import DecodeError, Message

from maplab_py.errors import MapError
from maplab_py.storage import maplab_map_pb2 as pb

VI_MAP_FOLDER = "vi_map"
METADATA = "metadata"
VI_MAP_METADATA = "vi_map_metadata"
SENSORS = "sensors.yaml"
RESOURCE_INFO = "resource_info"
COPY_AGAIN = "copy the map again from where it was recorded or saved"
"""What can be done about a damaged file."""
_GZIP_MAGIC = b"\x1f\x8b"


def is_map_folder(folder: Path) -> bool:
    """Tell whether a folder holds a map."""
    return (folder / VI_MAP_FOLDER / VI_MAP_METADATA).is_file()


def listed_files(folder: Path) -> list[Path]:
    """Return the binary files that vi_map_metadata lists.

    Raises:
        MapError: It is missing, cannot be read, or lists a path outside the folder.
    """
    path = folder / VI_MAP_FOLDER / VI_MAP_METADATA
    if not folder.exists():
        raise MapError(f"{folder}: there is no such folder")
    if not path.is_file():
        raise MapError(f"{folder} is not a map: it has no {VI_MAP_FOLDER}/{VI_MAP_METADATA}")
    metadata = pb.VIMapMetadata()
    read_text_message(path, metadata)
    files = []
    for entry in metadata.files:
        relative = PurePosixPath(entry.path)
        if not entry.path or relative.is_absolute() or ".." in relative.parts:
            raise MapError(f"{path}: the path '{entry.path}' leaves the map's folder")
        files.append(folder / VI_MAP_FOLDER / relative)
    if len(set(files)) != len(files):
        raise MapError(f"{path}: a file is listed twice")
    return files


def read_text_message(path: Path, message: Message) -> None:
    """Parse a text-format file.

    Raises:
        MapError: The file cannot be read or parsed.
    """
    try:
        text_format.Parse(path.read_text(encoding="utf-8"), message, allow_unknown_field=True)
    except (OSError, UnicodeDecodeError) as error:
        raise MapError(f"{path}: cannot be read ({error})") from error
    except text_format.ParseError as error:
        raise MapError(f"{path}: is not a text-format message ({error})") from error


def read_message(path: Path, message: Message, max_bytes: int) -> int:
    """Parse a binary file, gzip or not; return its unpacked size.

    Raises:
        MapError: The file is missing, truncated, damaged, or larger than max_bytes.
    """
    data = read_bytes(path, max_bytes)
    try:
        message.ParseFromString(data)
    except DecodeError as error:
        raise MapError(
            f"{path}: is damaged: not a message of the map format; {COPY_AGAIN}"
        ) from error
    return len(data)


def read_bytes(path: Path, max_bytes: int) -> bytes:
    """Read and, if need be, unpack a file; see `read_message` for errors."""
    try:
        packed = path.read_bytes()
    except OSError as error:
        raise MapError(f"{path}: is listed but cannot be read ({error.strerror})") from error
    too_large = (
        f"{path}: unpacks to more than {max_bytes // 1_000_000} MB; "
        "raise --proto_max_size_megabytes if the map is really that large"
    )
    if not packed.startswith(_GZIP_MAGIC):
        if len(packed) > max_bytes:
            raise MapError(too_large)
        return packed
    unpacker = zlib.decompressobj(wbits=31)
    try:
        data = unpacker.decompress(packed, max_bytes + 1)
    except zlib.error as error:
        raise MapError(f"{path}: is damaged: wrong gzip data ({error}); {COPY_AGAIN}") from error
    if len(data) > max_bytes:
        raise MapError(too_large)
    if not unpacker.eof:
        raise MapError(f"{path}: is truncated: the gzip data ends early; {COPY_AGAIN}")
    return data
