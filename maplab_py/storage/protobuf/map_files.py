"""List, unpack and parse the files of a map folder, with bounds on their size."""

import stat
import zlib
from enum import IntEnum
from pathlib import Path, PurePosixPath

from google.protobuf import text_format
from google.protobuf.message import DecodeError, Message

from maplab_py.errors import MapError
from maplab_py.input_files import DEFAULT_MAX_BYTES, RAISE_THE_BOUND, TooLarge, inflate
from maplab_py.input_files import read_bytes as read_file
from maplab_py.input_files import read_text as read_text_file
from maplab_py.report import counted
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.protobuf.scan import MemoryBudget

VI_MAP_FOLDER = "vi_map"
METADATA = "metadata"
VI_MAP_METADATA = "vi_map_metadata"
MISSIONS = "missions"
SENSORS = "sensors.yaml"
RESOURCE_INFO = "resource_info"
COPY_AGAIN = "copy the map again from where it was recorded or saved"
"""Remedy for a damaged file, used in error messages."""
_GZIP_MAGIC = b"\x1f\x8b"
_GZIP = 31
"""zlib's window size for gzip streams with checksum."""
_TEXT_PARTS = 200
"""Memory of a parsed text message per byte of text (measured: up to 140)."""


class FileKind(IntEnum):
    """Kind of entities in a file of a map (proto values)."""

    MISSIONS = 0
    VERTICES = 1
    EDGES = 2
    LANDMARK_INDEX = 3


def is_map_folder(folder: Path) -> bool:
    """Return whether a folder holds a map."""
    try:
        return (folder / VI_MAP_FOLDER / VI_MAP_METADATA).is_file()
    except OSError:  # a folder that may not be entered, a name that is too long
        return False


def listed_files(folder: Path, max_bytes: int = DEFAULT_MAX_BYTES) -> list[tuple[FileKind, Path]]:
    """Return the binary files that vi_map_metadata lists, with their kinds.

    Raises:
        MapError: It is missing, cannot be read, lists a path outside the folder, a file twice or
            of no known kind, or no missions or vertices.
    """
    path = folder / VI_MAP_FOLDER / VI_MAP_METADATA
    is_none = f"{folder} is not a map: it has no {VI_MAP_FOLDER}/{VI_MAP_METADATA}"
    try:
        if not folder.exists():
            raise MapError(f"{folder}: there is no such folder")
        if not stat.S_ISREG(path.stat().st_mode):
            raise MapError(is_none)
    except (FileNotFoundError, NotADirectoryError):
        raise MapError(is_none) from None
    except OSError as error:
        raise MapError(f"{path}: cannot be read ({error.strerror})") from error
    metadata = pb.VIMapMetadata()
    read_text_message(path, metadata, max_bytes)
    files = [_listed_file(path, entry) for entry in metadata.files]
    seen: set[Path] = set()
    for _, file in files:
        if file in seen:
            raise MapError(f"{path}: {file.name} is listed twice")
        seen.add(file)
    for kind in (FileKind.MISSIONS, FileKind.VERTICES):
        if kind not in {present for present, _ in files}:
            raise MapError(
                f"{path}: lists no file of {kind.name.lower()} (file_type {kind:d}); {COPY_AGAIN}"
            )
    return files


def _listed_file(path: Path, entry: pb.FileTypeWithPath) -> tuple[FileKind, Path]:
    if not entry.HasField("path") or not entry.path:
        raise MapError(f"{path}: an entry of 'files' has no path")
    relative = PurePosixPath(entry.path)
    if relative.is_absolute() or ".." in relative.parts or "\0" in entry.path:
        raise MapError(f"{path}: the path '{entry.path}' leaves the map's folder")
    if not entry.HasField("file_type") or entry.file_type not in list(FileKind):
        said = entry.file_type if entry.HasField("file_type") else "no number"
        raise MapError(f"{path}: file_type of '{entry.path}' is {said}; 0 to 3 are known")
    return FileKind(entry.file_type), path.parent / relative


def read_text_message(
    path: Path,
    message: Message,
    max_bytes: int = DEFAULT_MAX_BYTES,
    *,
    allow_unknown_field: bool = False,
) -> None:
    """Parse a text-format file.

    Raises:
        MapError: The file is too large, cannot be read or parsed, or has a field that the format
            does not know.
    """
    try:
        text = read_text_file(path, max_bytes // _TEXT_PARTS, error=MapError)
        text_format.Parse(text, message, allow_unknown_field=allow_unknown_field)
    except UnicodeDecodeError as error:
        raise MapError(f"{path}: cannot be read (it is not UTF-8 text)") from error
    except OSError as error:
        raise MapError(f"{path}: cannot be read ({error.strerror})") from error
    except (text_format.ParseError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise MapError(f"{path}: is not a text-format message ({reason})") from error


def read_message(path: Path, message: Message, budget: MemoryBudget) -> int:
    """Parse a binary file, compressed with gzip or not, and return its unpacked size.

    Raises:
        MapError: The file is missing, truncated, damaged, larger than the bound, or takes more
            memory than is left for it.
    """
    data = read_unpacked(path, budget.max_bytes)
    parse_message(path, data, message, budget)
    return len(data)


def parse_message(
    path: Path, data: bytes | bytearray, message: Message, budget: MemoryBudget
) -> None:
    """Parse the unpacked bytes of a file; see `read_message` for errors."""
    budget.admit(path, data, message.DESCRIPTOR)
    try:
        message.ParseFromString(memoryview(data))  # type: ignore[arg-type]
    except DecodeError as error:
        raise MapError(
            f"{path}: is damaged: not a message of the map format; {COPY_AGAIN}"
        ) from error


def read_unpacked(path: Path, max_bytes: int) -> bytes | bytearray:
    """Read a file and unpack all its gzip members, if it has any; see `read_message` for errors."""
    try:
        packed = read_file(path, max_bytes, error=MapError)
    except FileNotFoundError as error:
        raise MapError(f"{path}: is listed but not there; {COPY_AGAIN}") from error
    except OSError as error:
        raise MapError(f"{path}: is listed but cannot be read ({error.strerror})") from error
    if not packed.startswith(_GZIP_MAGIC):
        return packed
    rest = memoryview(packed)
    data = bytearray()
    try:
        while rest:
            if bytes(rest[:2]) != _GZIP_MAGIC:
                raise MapError(
                    f"{path}: is damaged: {counted(len(rest), 'byte')} follow the gzip data; "
                    f"{COPY_AGAIN}"
                )
            content, size = inflate(rest, max_bytes - len(data), wbits=_GZIP)
            data = data + content if data else content
            rest = rest[size:]
    except TooLarge as error:
        raise MapError(
            f"{path}: unpacks to more than {max_bytes / 1e6:g} MB; {RAISE_THE_BOUND}"
        ) from error
    except EOFError as error:
        raise MapError(f"{path}: is truncated: the gzip data ends early; {COPY_AGAIN}") from error
    except zlib.error as error:
        raise MapError(f"{path}: is damaged: wrong gzip data ({error}); {COPY_AGAIN}") from error
    return data
