"""A temporary folder for resource files of maps that have not been saved yet."""

import shutil
import tempfile
import weakref
from collections.abc import Iterable
from pathlib import Path

from maplab_py.atomic import write_file
from maplab_py.errors import UserError


class StagedFolder:
    """A temporary folder that exists as long as a map or another object refers to it.

    Undo and failed commands drop the maps that refer to it, and its files with them; saving copies
    the files into the resource folder of the saved map.
    """

    def __init__(self, parent: Path | None = None) -> None:
        """Make the folder in `parent`, by default in the system's folder for temporary files.

        Raises:
            UserError: It cannot be made.
        """
        try:
            self.path = Path(tempfile.mkdtemp(prefix="maplab-resources-", dir=parent))
        except OSError as error:
            raise UserError(
                f"{parent or tempfile.gettempdir()}: no temporary folder for resources can be made "
                f"({error.strerror}): {_REMEDY}"
            ) from error
        self._finalizer = weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)

    def write(self, relative: Path, chunks: Iterable[bytes]) -> None:
        """Write a file completely or not at all.

        Raises:
            UserError: It cannot be written, as on a full disk.
        """
        try:
            write_file(self.path / relative, chunks, durable=False)
        except UserError as error:
            raise UserError(f"{error}: {_REMEDY}") from error

    def link(self, relative: Path, target: Path) -> None:
        """Make a symbolic link to a file outside.

        Raises:
            UserError: It cannot be made.
        """
        place = self.path / relative
        try:
            place.parent.mkdir(parents=True, exist_ok=True)
            place.symlink_to(target.absolute())
        except OSError as error:
            raise UserError(
                f"{place}: the link cannot be made ({error.strerror}): {_REMEDY}"
            ) from error


_REMEDY = "free space on the disk, or set TMPDIR to a folder that has more"
