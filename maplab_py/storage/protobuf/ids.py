"""Conversion of ids between messages and columns, and unknown fields of messages.

The bytes of the words of an id are stored in the order of its hexadecimal digits. Words are
therefore byte-swapped between file and memory.
"""

from collections.abc import Callable, Iterable, Sequence
from itertools import chain, islice
from operator import attrgetter
from typing import Any

import numpy as np
from google.protobuf.message import Message
from google.protobuf.unknown_fields import UnknownFieldSet

from maplab_py.array_types import I64, U64
from maplab_py.errors import MapError

_WORDS = attrgetter("words")
_WORTH_A_KERNEL = 50_000
"""Number of ids after which loading the compiled kernel takes less time than their objects."""
_MANY = 4
"""Number of ids per message from which its bytes are read in less time than their objects."""
LARGE_MESSAGE = 1 << 18
"""Bytes of a message from which its ids are read without its parts becoming objects."""
_PORTION = 4096
"""Number of ids per batch: their Python views take ten times the memory of the ids."""


class _Read:
    """Number of ids that this process has read; only the way of reading depends on it."""

    ids = 0


def is_worth_a_kernel(ids: int) -> bool:
    """Tell whether this process has read enough ids, with some more, to load the compiled kernel."""
    _Read.ids += ids
    return _Read.ids >= _WORTH_A_KERNEL


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


def ids_of_field(
    messages: Sequence[Any], field: str, where: str, name: Callable[[int], str]
) -> tuple[U64, I64]:
    """Return the ids (N, 2) in a repeated field of messages (M,), and their number (M,) in each.

    Args:
        field: Name of the field.
        where: The field, for the message of an error.
        name: Gives file and id of a message.

    Raises:
        MapError: An id has neither two words nor none; names entity and field.
    """
    counts = np.fromiter((len(getattr(m, field)) for m in messages), np.int64, len(messages))
    total = int(counts.sum())
    if total > _MANY * len(counts) and is_worth_a_kernel(total):
        ids, is_regular = _ids_in_bytes(messages, field, total)
        if is_regular:
            return ids, counts
    owner = np.repeat(np.arange(len(counts)), counts)
    all_ids = (i for m in messages for i in getattr(m, field))
    return ids_of(all_ids, where, lambda place: name(int(owner[place]))), counts


def _ids_in_bytes(messages: Sequence[Any], field: str, total: int) -> tuple[U64, bool]:
    """Return the ids of a field, read from the bytes of the messages, and whether all are regular."""
    from maplab_py.storage.protobuf.id_fields_kernel import read_ids

    number = messages[0].DESCRIPTOR.fields_by_name[field].number
    parts = [message.SerializePartialToString() for message in messages]
    start = np.zeros(len(parts) + 1, dtype=np.int64)
    np.cumsum([len(part) for part in parts], out=start[1:])
    data = np.frombuffer(b"".join(parts), dtype=np.uint8)
    ids, is_regular = read_ids(data, start[:-1], start[1:], number, total)
    return ids.byteswap(), bool(is_regular)


def ids_of_parts(data: bytes | bytearray, field: int, inner: Sequence[int]) -> list[U64] | None:
    """Return the ids (N, 2) in each of some fields of the N parts of a large message.

    Nothing but the ids is allocated; messages of all parts would take a hundred times as much.

    Args:
        data: Bytes of the message.
        field: Number of the repeated field whose parts are asked for.
        inner: Numbers of fields of the parts that hold one id each.

    Returns:
        Ids by inner field; None where the message is small, or holds something else.
    """
    if len(data) < LARGE_MESSAGE or data[1] == 0:  # the first part is empty: no kernel is needed
        return None
    from maplab_py.storage.protobuf.id_fields_kernel import parts_of_field, read_ids

    content = np.frombuffer(memoryview(data).toreadonly(), dtype=np.uint8)
    begin, end, is_regular = parts_of_field(content, field)
    result = []
    for number in inner if is_regular else ():
        ids, is_regular = read_ids(content, begin, end, number, len(begin))
        result.append(ids.byteswap())
        if not is_regular:
            return None
    return result if is_regular else None
