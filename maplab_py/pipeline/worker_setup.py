"""Set-up of a local worker: Ctrl-C reaches all processes of a terminal, but the driver alone acts on it."""

import signal
from typing import Any


def dask_setup(worker: Any) -> None:  # noqa: ARG001 - the name and signature are Dask's
    """Ignore Ctrl-C; the driver stops the worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
