"""By which contents a finished task is known."""

import hashlib
from pathlib import Path

from maplab_py.errors import UserError
from maplab_py.storage.map_saving import CARD_FILE


def folder_hash(folder: Path) -> str:
    """Return the SHA-256 of the names and contents of all files below a folder.

    Hidden files, and the cards of maps, which have paths, do not count.

    Raises:
        UserError: A file cannot be read, or there is no such folder.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: is no folder")
    digest = hashlib.sha256()
    try:
        for path in sorted(folder.rglob("*")):
            inner = path.relative_to(folder)
            is_hidden = any(part.startswith(".") for part in inner.parts)
            if is_hidden or path.name == CARD_FILE or not path.is_file():
                continue
            with path.open("rb") as file:
                content = hashlib.file_digest(file, "sha256").digest()
            digest.update(inner.as_posix().encode("utf-8", "surrogateescape") + b"\0" + content)
    except OSError as error:
        raise UserError(f"{error.filename or folder}: cannot be read ({error.strerror})") from error
    return digest.hexdigest()
