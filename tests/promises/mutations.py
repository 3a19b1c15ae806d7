"""Mutate valid input: bits flip, pieces are lost, and numbers are such as no program would write."""

import struct
from collections.abc import Sequence
from random import Random

from hypothesis import strategies as st

EXTREMES = [
    *(str(number).encode() for number in (-1, 0, 1 << 31, 1 << 32, 1 << 63, 1 << 64, 10**12, -(10**12), 10**30)),
    *[b"9" * 5000, b"nan", b"NaN", b"inf", b"-inf", b"1e999", b"1e-999", b"0x10", b"1_000", b"true", b"null", b'""'],
    *[
        b"[" * 3000,
        b"{" * 3000,
        b"(" * 3000,
        b'{"a":' * 1500,
        b"&a [*a]",
        b"../../x",
        b"/etc/passwd",
        b"\0",
        b"\xff\xfe",
    ],
    *(struct.pack("<I", number) for number in (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)),
    *(struct.pack(">Q", number) for number in (0x7FFFFFFFFFFFFFFF, 0xFFFFFFFFFFFFFFFF, 1 << 40)),
    *[b"\x80" * 9 + b"\x01", b"\xff" * 9 + b"\x7f", b"\n", b"\r\n", b",", b'"', b"'", b"\x1b[2J", b"\xc3\x28"],
]
LONGEST = 1 << 18  # bytes of what comes of it
KINDS = 8


def mutate(data: bytes, donors: Sequence[bytes], random: Random) -> bytes:
    """Return ``data`` after some changes; pieces of ``donors`` may come into it."""
    for _ in range(random.choice((1, 1, 1, 2, 3, 5))):
        data = _change(data, donors, random)[:LONGEST]
    return data


def _change(data: bytes, donors: Sequence[bytes], random: Random) -> bytes:
    place = random.randrange(len(data) + 1)
    stop = min(len(data), place + random.choice((1, 1, 2, 4, 8, 30, 300, len(data))))
    kind = random.randrange(KINDS)
    if kind == 0 and data:  # flip a bit
        at = min(place, len(data) - 1)
        return data[:at] + bytes([data[at] ^ 1 << random.randrange(8)]) + data[at + 1 :]
    if kind == 1:  # lose a piece
        return data[:place] + data[stop:]
    if kind == 2:  # cut off
        return data[:place]
    if kind == 3:  # repeat a piece
        return data[:place] + data[place:stop] * random.choice((2, 3, 50, 1000)) + data[stop:]
    if kind == 4:  # a piece of another input, or of another place
        donor = random.choice([*donors, data]) or b"\0"
        start = random.randrange(len(donor))
        return data[:place] + donor[start : start + random.choice((1, 4, 30, 300))] + data[stop:]
    if kind == 5:  # a number or word that is extreme, in between
        return data[:place] + random.choice(EXTREMES) + data[place:]
    if kind == 6:  # An extreme replaces a piece.
        return data[:place] + random.choice(EXTREMES) + data[stop:]
    return data[:place] + random.randbytes(random.choice((1, 2, 8, 64))) + data[stop:]


def inputs(examples: Sequence[bytes]) -> st.SearchStrategy[bytes]:
    """Return a strategy of valid inputs after changes, and of bytes that have nothing to do with them."""
    changed = st.builds(
        lambda example, seed: mutate(example, examples, Random(seed)),
        st.sampled_from(list(examples)),
        st.integers(0, (1 << 32) - 1),
    )
    return st.one_of(changed, changed, changed, changed, st.binary(max_size=2000))
