"""Atomic writing of files and folders; nothing else in this project replaces files on disk.

New content is written under a hidden name beside the target, flushed to disk and renamed. A reader,
also after a crash, sees either the old or the new content, never a part. A writer holds a lock
(flock). Files left by a killed process are deleted by the next writer or reader of the same target
that holds the lock.
"""

from maplab_py.atomic.files import PendingFile, link_or_copy, replaced_file, write_file
from maplab_py.atomic.folders import move_folder, recover, replaced_folder

__all__ = [
    "PendingFile",
    "link_or_copy",
    "move_folder",
    "recover",
    "replaced_file",
    "replaced_folder",
    "write_file",
]
