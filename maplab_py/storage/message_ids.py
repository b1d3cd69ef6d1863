"""Conversion of ids between messages and columns, and unknown fields of messages.

The bytes of the words of an id are stored in the order of its hexadecimal digits. Words are
therefore byte-swapped between file and memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import chain, islice
from operator import attrgetter
from typing import Any

import numpy as np
from google.protobuf.message import Message
from google.protobuf.unknown_fields import UnknownFieldSet

from maplab_py.array_types import U64
from maplab_py.errors import MapError

_WORDS = attrgetter("words")
_PORTION = 4096
"""Number of ids per batch: their Python views take ten times the memory of the ids."""


def ids_of(messages: Iterable[Any], where: str, name: Callable[[int], str] | None = None) -> U64:
    """Return ids (N, 2) of Id messages; an id without words is zero.

    Args:
        messages: Id messages.
        where: The field, for the message of an error.
        name: Gives file and id of the entity of a message.

    Raises:
        MapError: An id has neither two words nor none; names entity and field.
    """
    source, parts = iter(messages), list[U64]()
    while portion := list(islice(source, _PORTION)):
        lists = list(map(_WORDS, portion))
        if set(map(len, lists)) <= {2}:
            flat = chain.from_iterable(lists)
            parts.append(np.fromiter(flat, np.uint64, 2 * len(lists)).reshape(-1, 2))
            continue
        padded: list[int] = []
        for row, words in enumerate(lists):
            if len(words) not in (0, 2):
                owner = f"{name(_PORTION * len(parts) + row)}: " if name else ""
                raise MapError(f"{owner}{where}: an id has {len(words)} words instead of 2")
            padded.extend(words if len(words) else (0, 0))
        parts.append(np.array(padded, dtype=np.uint64).reshape(-1, 2))
    return (np.concatenate(parts) if parts else np.zeros((0, 2), dtype=np.uint64)).byteswap()


def unknown_bytes(message: Message) -> bytes:
    """Return the fields of a message (not of its parts) that the schema does not know."""
    if not len(UnknownFieldSet(message)):
        return b""
    known = type(message)()
    known.CopyFrom(message)
    for field, _ in message.ListFields():
        known.ClearField(field.name)
    return known.SerializeToString(deterministic=True)
