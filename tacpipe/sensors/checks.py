"""Check sums of frames, over whole arrays: bytes (frame, byte) in, one number a frame out."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tacpipe.arrays import Bytes, Counts

Step = Callable[[NDArray[np.uint32], NDArray[np.uint32]], NDArray[np.uint32]]  # (value,), (256,) to (value,)

MOST_LOOKED_UP = 1 << 18  # bytes at a time, which bounds the memory of a CRC


def sum8(data: Bytes) -> Bytes:
    """Return the sum of the bytes of each frame modulo 256 (frame,)."""
    total: Bytes = data.sum(axis=1, dtype=np.uint8)
    return total


def sum16(data: Bytes) -> Counts:
    """Return the sum of the bytes of each frame modulo 65,536 (frame,)."""
    total: Counts = data.sum(axis=1, dtype=np.uint16)
    return total


def lrc(data: Bytes) -> Bytes:
    """Return the two's complement of the sum of each frame (frame,): with it, the sum is 0."""
    return (-sum8(data)).astype(np.uint8)


def xor8(data: Bytes) -> Bytes:
    """Return the exclusive or of the bytes of each frame (frame,)."""
    total: Bytes = np.bitwise_xor.reduce(data, axis=1)
    return total


def crc8(data: Bytes, polynomial: int = 0x07) -> Bytes:
    """Return the CRC-8 of each frame (frame,): most significant bit first, from 0."""
    return _crc(data, _high_bit_first, polynomial, 8, b"").astype(np.uint8)


def crc16_modbus(data: Bytes) -> Counts:
    """Return the CRC-16/MODBUS of each frame (frame,): polynomial 0xA001 reflected, from 0xFFFF.

    Source: MODBUS over Serial Line, V1.02, section 6.2.2.
    """
    return _crc(data, _low_bit_first, 0xA001, 16, b"\xff\xff").astype(np.uint16)


def crc16_ccitt(data: Bytes) -> Counts:
    """Return the CRC-16 of each frame (frame,): polynomial 0x1021, most significant bit first, from 0xFFFF."""
    return _crc(data, _high_bit_first, 0x1021, 16, b"\xff\xff").astype(np.uint16)


def crc16_wts(data: Bytes) -> Counts:
    """Return the check sum of Weiss WTS frames (frame,): the table of 0x1021, but shifted to the right, from 0xFFFF."""
    return _crc(data, _mixed, 0x1021, 16, b"\xff\xff").astype(np.uint16)


def crc32(data: Bytes) -> NDArray[np.uint32]:
    """Return the CRC-32 of each frame (frame,) as of Ethernet and zip: 0xEDB88320 reflected, from and with all bits."""
    return ~_crc(data, _low_bit_first, 0xEDB88320, 32, b"\xff\xff\xff\xff")


Kind = Callable[[int, int], tuple[NDArray[np.uint32], Step]]  # polynomial and bits to a table (256,) and a step


def _crc(data: Bytes, kind: Kind, polynomial: int, bits: int, start: bytes) -> NDArray[np.uint32]:
    """Return the CRC of each frame (frame,); ``start`` is its first value, byte by byte as data meets it.

    A CRC is the exclusive or of what its bytes add, each by how many follow it, so that all are looked up at once.
    """
    count = data.shape[1]
    unused = start[count:]  # bytes of the first value that are combined with no byte
    remainder = (
        int.from_bytes(unused.ljust(len(start), b"\x00"))
        if kind is _high_bit_first
        else int.from_bytes(unused, "little")
    )
    crc = np.full(len(data), remainder, dtype=np.uint32)
    if not count:
        return crc
    added = _added(kind, polynomial, bits, 1 << (count - 1).bit_length())  # (bytes that follow, value)
    places = np.arange(count - 1, -1, -1) * 256
    block = max(1, MOST_LOOKED_UP // count)
    flat = added.ravel()
    for first in range(0, len(data), block):
        crcs = flat.take(data[first : first + block] + places)  # (frame, byte)
        crc[first : first + block] ^= np.bitwise_xor.reduce(crcs, axis=1)
    for place, value in enumerate(start[:count]):
        crc ^= added[count - 1 - place, value]
    return crc


@functools.lru_cache(maxsize=32)
def _added(kind: Kind, polynomial: int, bits: int, count: int) -> NDArray[np.uint32]:
    """Return what each value of a byte adds to a CRC (bytes that follow, value), for fewer than ``count`` that follow."""
    table, step = kind(polynomial, bits)
    rows = [table]
    while len(rows) < count:
        rows.append(step(rows[-1], table))
    return np.stack(rows)


def _low_bit_first(polynomial: int, bits: int) -> tuple[NDArray[np.uint32], Step]:
    """Return table and step of a CRC that takes the least significant bit first."""
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ np.uint32(polynomial), table >> 1)
    return table, _step_low_bit_first


def _high_bit_first(polynomial: int, bits: int) -> tuple[NDArray[np.uint32], Step]:
    """Return table and step of a CRC that takes the most significant bit first."""
    mask = np.uint32((1 << bits) - 1)
    table = np.arange(256, dtype=np.uint32) << np.uint32(bits - 8)
    for _ in range(8):
        table = np.where(table >> (bits - 1), (table << 1) ^ np.uint32(polynomial), table << 1) & mask

    def step(crc: NDArray[np.uint32], table: NDArray[np.uint32]) -> NDArray[np.uint32]:
        stepped: NDArray[np.uint32] = table[crc >> (bits - 8)] ^ ((crc << 8) & mask)
        return stepped

    return table, step


def _mixed(polynomial: int, bits: int) -> tuple[NDArray[np.uint32], Step]:
    """Return the table of `_high_bit_first` with the step of `_low_bit_first`."""
    return _high_bit_first(polynomial, bits)[0], _step_low_bit_first


def _step_low_bit_first(crc: NDArray[np.uint32], table: NDArray[np.uint32]) -> NDArray[np.uint32]:
    stepped: NDArray[np.uint32] = table[crc & 0xFF] ^ (crc >> 8)
    return stepped
