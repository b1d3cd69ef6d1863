"""Mutations that keep the form of an input: words and lines of text, pieces of bytes."""

import random
import re
import struct

WORDS = (
    *(b"nan", b"inf", b"-1", b"0", b"1e308", b"-1e-320", b"1e400", b"abc", b"null", b"true", b"''"),
    *(b"9223372036854775808", b"-9223372036854775809", b"99999999999999999999999", b"0x1", b"1_0"),
    *(
        b"[]",
        b"{}",
        b"[1, 2]",
        b"{a: 1}",
        b"[[1]]",
        b"\xff",
        b"\0\0\0\0",
        b"\xff\xff\xff\xff\xff\xff\xff\x7f",
    ),
)
NUMBERS = (
    *(struct.pack("<i", value) for value in (0, 1, 2, -1, 7, 1 << 16, (1 << 31) - 1, -(1 << 31))),
    *(struct.pack("<q", value) for value in (0, 1, 3, -1, 1 << 32, (1 << 63) - 1, -(1 << 63))),
    *(struct.pack("<d", value) for value in (0.0, -1.0, 1e-300, 1e200, float("nan"), float("inf"))),
    *(struct.pack("<f", value) for value in (1.0, 1e30, float("nan"), float("inf"))),
)
_WORD = re.compile(rb"[-+.\w]+")


def mutated(rng: random.Random, data: bytes) -> bytes:
    """Return data with one change; the first byte, which chooses a file, stays."""
    head, body = data[:1], data[1:]
    if len(body) < 3:
        return data + rng.choice(WORDS)
    is_text = b"\0" not in body
    changes = (_with_other_word, _with_other_word, _with_other_lines, _with_other_bytes)
    change = rng.choice(changes if is_text else (*changes, _with_other_number, _with_other_number))
    return head + change(rng, body)


def _with_other_word(rng: random.Random, data: bytes) -> bytes:
    words = list(_WORD.finditer(data[:20_000]))
    if not words:
        return _with_other_bytes(rng, data)
    a, b = rng.choice(words).span()
    other = rng.choice(words).group() if rng.random() < 0.3 else rng.choice(WORDS)
    return data[:a] + other + data[b:]


def _with_other_number(rng: random.Random, data: bytes) -> bytes:
    number = rng.choice(NUMBERS)
    a = rng.randrange(max(1, len(data) - len(number)))
    return data[:a] + number + data[a + len(number) :]


def _with_other_lines(rng: random.Random, data: bytes) -> bytes:
    lines = data.split(b"\n")
    a, b = rng.randrange(len(lines)), rng.randrange(len(lines))
    kind = rng.randrange(3)
    if kind == 0:
        del lines[a]
    elif kind == 1:
        lines.insert(a, lines[b])
    else:
        lines[a], lines[b] = lines[b], lines[a]
    return b"\n".join(lines)


def _with_other_bytes(rng: random.Random, data: bytes) -> bytes:
    a = rng.randrange(len(data))
    b = min(len(data), a + rng.randrange(1, 64))
    kind = rng.randrange(4)
    if kind == 0:
        return data[:a] + data[b:]
    if kind == 1:
        return data[:b] + data[a:]
    if kind == 2:
        return data[:a]
    word = rng.choice(WORDS)
    return data[:a] + word + data[a + len(word) :]
