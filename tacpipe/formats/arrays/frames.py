"""Encoded pictures in arrays: bytes of their own length, or rows padded with zeros, as ALOHA keeps its cameras."""

from __future__ import annotations

import pyarrow as pa

from tacpipe.arrays import AnyArray
from tacpipe.formats.arrays.tree import Array, Tree

NAME = "data"  # of the column, as messages of images have it
MAGIC = {b"\xff\xd8\xff": "jpeg", b"\x89PNG": "png", b"RIFF": "webp"}  # how pictures begin


def encoding(content: bytes) -> str:
    r"""Return the encoding of a picture by its first bytes; empty where it is none of these.

    >>> encoding(b"\xff\xd8\xff\xe0"), encoding(b"abc")
    ('jpeg', '')
    """
    return next((name for start, name in MAGIC.items() if content.startswith(start)), "")


def encoded(tree: Tree, array: Array, row: int) -> bool:
    """Return whether a row of an array is an encoded picture, by its first bytes."""
    return bool(encoding(_bytes(tree.read(array, row, row + 1))[0]))


def size(tree: Tree, array: Array, row: int) -> int:
    """Return how many bytes a row of an array of pictures has."""
    return len(_bytes(tree.read(array, row, row + 1))[0])


def of(array: Array, values: AnyArray) -> tuple[pa.Field, pa.Array]:
    """Return field and values of the column of pictures: bytes as they were written, without the zeros behind them."""
    found = binary(array, values)
    kind = next(filter(None, (encoding(one.as_py()) for one in found)), "")
    about = {"quantity": "image", **({"encoding": kind} if kind else {})}
    return pa.field(NAME, pa.binary(), metadata=about), found


def binary(array: Array, values: AnyArray) -> pa.Array:
    """Return rows of bytes, without the zeros behind those that are padded."""
    rows = _bytes(values)
    if array.dtype.kind != "O":
        rows = [one.rstrip(b"\0") for one in rows]  # a JPEG ends in FF D9, a PNG in its check sum of IEND
    return pa.array(rows, pa.binary())


def _bytes(values: AnyArray) -> list[bytes]:
    return [bytes(memoryview(one)) for one in values]
