"""Call a function for many values in threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

Result = TypeVar("Result")


def map_in_threads(function: Callable[..., Result], *values: Iterable[Any]) -> list[Result]:
    """Return what a function returns for each value, in their order.

    Where memory does not suffice for the stack of a thread, this thread calls the function.

    Args:
        function: Releases Python's lock; raises no RuntimeError.
        values: One iterable for each argument, all of the same length.
    """
    arguments = list(zip(*values, strict=True))
    try:
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            return list(pool.map(lambda each: function(*each), arguments))
    except RuntimeError:
        return [function(*each) for each in arguments]
