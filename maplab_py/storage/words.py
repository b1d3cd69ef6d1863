"""Ids between messages and columns, and what a message holds that the schema does not know.

The bytes of an id's words are stored in the order of its hexadecimal digits, so that words are
byte-swapped between file and memory.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from operator import attrgetter
from typing import Any

import numpy as np
from google.protobuf.message import Message
from google.protobuf.unknown_fields import UnknownFieldSet
from numpy.typing import NDArray

from maplab_py.errors import MapError

U64 = NDArray[np.uint64]

_WORDS = attrgetter("words")


def ids_of(messages: Iterable[Any], where: str) -> U64:
    """Return ids (N, 2) of Id messages; one without words counts as zero.

    Raises:
        MapError: An id has neither two words nor none; `where` names the field.
    """
    lists = list(map(_WORDS, messages))
    if set(map(len, lists)) <= {2}:
        flat = chain.from_iterable(lists)
        return np.fromiter(flat, np.uint64, 2 * len(lists)).reshape(-1, 2).byteswap()
    padded: list[int] = []
    for words in lists:
        if len(words) not in (0, 2):
            raise MapError(f"{where}: an id has {len(words)} words instead of 2")
        padded.extend(words if len(words) else (0, 0))
    return np.array(padded, dtype=np.uint64).reshape(-1, 2).byteswap()


def unknown_bytes(message: Message) -> bytes:
    """Return the fields of a message (not of its parts) that the schema does not know."""
    if not len(UnknownFieldSet(message)):
        return b""
    known = type(message)()
    known.CopyFrom(message)
    for field, _ in message.ListFields():
        known.ClearField(field.name)
    return known.SerializeToString(deterministic=True)
