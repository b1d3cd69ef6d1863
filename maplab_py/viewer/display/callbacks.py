"""Callbacks of widgets."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any

logger = logging.getLogger(__name__)


def by_user(
    lock: threading.RLock, action: Callable[[Any], None], say: Callable[[str], None]
) -> Callable[[Any], None]:
    """Make a callback: only for what a page does, one at a time; errors are said and logged."""

    def callback(event: Any) -> None:
        if getattr(event, "client_id", None) is None:
            return
        try:
            with lock:
                action(event)
        except Exception:
            logger.exception("the viewer could not do what a page asked for")
            with lock:
                say("this could not be done: the log file has the reason")

    return callback
