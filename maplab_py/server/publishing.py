"""The published map: replaced as a whole after every change, with copies kept now and then.

Only files that have changed are written; the others are linked from the folder that is replaced.
"""

import contextlib
import shutil
import time
from collections.abc import Callable
from pathlib import Path

from maplab_py.atomic import link_or_copy, move_folder
from maplab_py.progress import SILENT, Progress
from maplab_py.server.options import PublishingOptions
from maplab_py.storage.native import is_map_folder, save_map
from maplab_py.storage.resources.store import copied_to_external, existing_files, in_map_folder
from maplab_py.storage.unchanged_files import WrittenFiles
from maplab_py.vimap import VIMap

_BACKUPS = 5
_SECONDS_UNPUBLISHED = (1.0, 20.0)
_PUBLISHING_SHARE = 0.1


def pause_s(duration_s: float) -> float:
    """Return the time between publications [s] while submaps are ready to be merged.

    Publications take a tenth of the time, within limits, so that the size of the map hardly slows the
    server down.
    """
    shortest_s, longest_s = _SECONDS_UNPUBLISHED
    return min(max(duration_s / _PUBLISHING_SHARE, shortest_s), longest_s)


class Publisher:
    """Writes a map to its folder, and keeps copies."""

    def __init__(self, options: PublishingOptions) -> None:
        """Prepare; nothing is written yet."""
        self.folder = Path(options.merged_map_folder).absolute()  # folder of the map
        self.backups = self.folder.parent / f"{self.folder.name}_backups"
        # when the map was last published [s, monotonic]; None = not yet
        self.published_s: float | None = None
        self.duration_s = 0.0  # how long that took
        # files_taken_over: how many of them were not written again
        # files: number of files of the map
        self.files = self.files_taken_over = 0
        self.is_compressed = True  # all files that were written are compressed
        self._options = options
        self._files: list[tuple[Path, Path]] = []
        self._written = WrittenFiles()
        self._backup_s = time.monotonic()
        self._is_backed_up = True

    def with_resources(self, submap: VIMap, folder: Path) -> VIMap:
        """Return a submap whose resources are, or will be, where those of the map are.

        Raises:
            MapError: A file is missing.
            UserError: The resource folder cannot be written.
        """
        if not len(submap.resources):
            return submap
        if self._options.resource_folder:
            return copied_to_external(submap, folder, Path(self._options.resource_folder))
        self._files += existing_files(submap, folder)
        return in_map_folder(submap)

    def publish(
        self, vi_map: VIMap, *, compress: bool = False, progress: Progress = SILENT
    ) -> None:
        """Replace the published map.

        Args:
            compress: Compress its files. That takes most of the time of a publication, so files that the
                next submap may change are stored as they are.

        Raises:
            UserError: The disk refuses.
        """
        began = time.monotonic()
        report = save_map(
            vi_map,
            self.folder,
            force=True,
            resource_files=self._files,
            written=self._written,
            compress=compress,
            progress=progress,
        )
        self.files, self.files_taken_over = report.files, self._written.reused
        self.is_compressed = compress
        self._files.clear()
        self.published_s = time.monotonic()
        self.duration_s = self.published_s - began
        self._is_backed_up = False

    def remove(self) -> None:
        """Delete the published map: its last mission was deleted."""
        if is_map_folder(self.folder):
            shutil.rmtree(self.folder, ignore_errors=True)

    def back_up(self) -> Path | None:
        """Keep a copy of the published map if it is time; return its folder.

        The files are linked, as a published file never changes. The oldest copies are deleted.

        Raises:
            OSError: It cannot be written.
        """
        interval_s = self._options.backup_interval_s
        is_due = interval_s and time.monotonic() - self._backup_s >= interval_s
        if not is_due or self._is_backed_up or not is_map_folder(self.folder):
            return None
        self._backup_s, self._is_backed_up = time.monotonic(), True
        self.backups.mkdir(exist_ok=True)
        copy = self.backups / ".copying"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(self.folder, copy, copy_function=link_or_copy, symlinks=True)
        target = self.backups / time.strftime("%Y%m%d_%H%M%S")
        with contextlib.suppress(FileNotFoundError):
            shutil.rmtree(target)
        move_folder(copy, target)
        for old in sorted(p for p in self.backups.iterdir() if p.name[0] != ".")[:-_BACKUPS]:
            shutil.rmtree(old, ignore_errors=True)
        return target


class Display:
    """Shows the latest published map at most every so often; building a scene takes time, too."""

    def __init__(self, watch: Callable[[VIMap], None] | None, interval_s: float) -> None:
        """Show nothing yet.

        Args:
            watch: Gets maps; None = nobody looks.
            interval_s: Shortest time between two maps [s].
        """
        self._watch, self._interval_s = watch, interval_s
        self._waiting: VIMap | None = None
        self._next_s = 0.0

    def offer(self, vi_map: VIMap | None) -> None:
        """Take a map that has just been published, and show it now or later."""
        self._waiting = vi_map
        self.show()

    def show(self, *, at_once: bool = False) -> None:
        """Show the map that waits if its time has come, or at once."""
        is_due = at_once or time.monotonic() >= self._next_s
        if self._watch is None or self._waiting is None or not is_due:
            return
        vi_map, self._waiting = self._waiting, None
        self._watch(vi_map)
        self._next_s = time.monotonic() + self._interval_s
