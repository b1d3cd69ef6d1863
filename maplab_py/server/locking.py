"""One server per spool."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator

from maplab_py.atomic.system import opened_locked
from maplab_py.errors import UserError
from maplab_py.server.spool import Spool


@contextlib.contextmanager
def locked_spool(spool: Spool) -> Iterator[None]:
    """Hold the lock of a spool; the system releases it when the process ends, however it ends.

    Raises:
        UserError: Another process holds it, or it cannot be made.
    """
    try:
        descriptor = opened_locked(spool.lock)
    except OSError as error:
        raise UserError(f"{spool.lock}: cannot be locked ({error.strerror})") from error
    if descriptor is None:
        raise UserError(
            f"--spool={spool.root}: another server{_process(spool)} works on it; stop it with "
            "serve_stop, or give another spool"
        )
    try:
        yield
    finally:
        os.close(descriptor)


def _process(spool: Spool) -> str:
    try:
        return f" (process {int(json.loads(spool.address.read_text())['process'])})"
    except (OSError, ValueError, KeyError, TypeError):
        return ""
