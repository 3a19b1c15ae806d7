"""Compute checksums of many frames at once: from bytes (frame, byte) to one number per frame."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tacpipe.arrays import Bytes, Counts

# maps values (value,) and a table (256,) to new values (value,)
Step = Callable[[NDArray[np.uint32], NDArray[np.uint32]], NDArray[np.uint32]]

MAX_BLOCK = 1 << 18  # bytes that are looked up at once, which bounds the memory


def sum8(data: Bytes) -> Bytes:
    """Return the sum of the bytes of each frame modulo 256 (frame,)."""
    total: Bytes = data.sum(axis=1, dtype=np.uint8)
    return total


def sum16(data: Bytes) -> Counts:
    """Return the sum of the bytes of each frame modulo 65,536 (frame,)."""
    total: Counts = data.sum(axis=1, dtype=np.uint16)
    return total


def lrc(data: Bytes) -> Bytes:
    """Return the two's complement of the 8-bit sum of each frame (frame,)."""
    return (-sum8(data)).astype(np.uint8)


def xor8(data: Bytes) -> Bytes:
    """Return the exclusive or of the bytes of each frame (frame,)."""
    total: Bytes = np.bitwise_xor.reduce(data, axis=1)
    return total


def crc8(data: Bytes, polynomial: int = 0x07) -> Bytes:
    """Return the CRC-8 of each frame (frame,): most significant bit first, initial value 0."""
    return _crc(data, _high_bit_first, polynomial, 8, b"").astype(np.uint8)


def crc16_modbus(data: Bytes) -> Counts:
    """Return the CRC-16/MODBUS of each frame (frame,): polynomial 0xA001 reflected, initial value 0xFFFF.

    Source: MODBUS over Serial Line, V1.02, section 6.2.2.
    """
    return _crc(data, _low_bit_first, 0xA001, 16, b"\xff\xff").astype(np.uint16)


def crc16_ccitt(data: Bytes) -> Counts:
    """Return the CRC-16 of each frame (frame,): polynomial 0x1021, most significant bit first, initial value 0xFFFF."""
    return _crc(data, _high_bit_first, 0x1021, 16, b"\xff\xff").astype(np.uint16)


def crc16_wts(data: Bytes) -> Counts:
    """Return the checksum of Weiss WTS frames (frame,): the table of 0x1021, shifted to the right, initial value 0xFFFF."""
    return _crc(data, _mixed_table, 0x1021, 16, b"\xff\xff").astype(np.uint16)


def crc32(data: Bytes) -> NDArray[np.uint32]:
    """Return the CRC-32 (Ethernet, zip) of each frame (frame,): 0xEDB88320 reflected, initial and final XOR all ones."""
    return ~_crc(data, _low_bit_first, 0xEDB88320, 32, b"\xff\xff\xff\xff")


# maps a polynomial and a number of bits to a table (256,) and a step
CrcKind = Callable[[int, int], tuple[NDArray[np.uint32], Step]]


def _crc(data: Bytes, kind: CrcKind, polynomial: int, bits: int, start: bytes) -> NDArray[np.uint32]:
    """Return the CRC of each frame (frame,). ``start`` is the initial value, in the order of data bytes.

    A CRC is linear: each byte contributes a value that depends only on the byte and its distance from the end. The
    contributions of all bytes are looked up at once and combined by exclusive or.
    """
    count = data.shape[1]
    excess = start[count:]  # bytes of the initial value beyond the data
    remainder = (
        int.from_bytes(excess.ljust(len(start), b"\x00"))
        if kind is _high_bit_first
        else int.from_bytes(excess, "little")
    )
    crc = np.full(len(data), remainder, dtype=np.uint32)
    if not count:
        return crc
    contributions = _contributions(kind, polynomial, bits, 1 << (count - 1).bit_length())  # (bytes that follow, value)
    offsets = np.arange(count - 1, -1, -1) * 256
    block = max(1, MAX_BLOCK // count)
    flat = contributions.ravel()
    for first in range(0, len(data), block):
        crcs = flat.take(data[first : first + block] + offsets)  # (frame, byte)
        crc[first : first + block] ^= np.bitwise_xor.reduce(crcs, axis=1)
    for position, value in enumerate(start[:count]):
        crc ^= contributions[count - 1 - position, value]
    return crc


@functools.lru_cache(maxsize=32)
def _contributions(kind: CrcKind, polynomial: int, bits: int, count: int) -> NDArray[np.uint32]:
    """Return the contribution of each byte value to a CRC (bytes that follow, value), for up to ``count`` - 1 bytes."""
    table, step = kind(polynomial, bits)
    rows = [table]
    while len(rows) < count:
        rows.append(step(rows[-1], table))
    return np.stack(rows)


def _low_bit_first(polynomial: int, bits: int) -> tuple[NDArray[np.uint32], Step]:
    """Return the table (256,) of a CRC with the least significant bit first, and the function that appends a zero byte.

    ``bits`` is not used.
    """
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ np.uint32(polynomial), table >> 1)
    return table, _step_low_bit_first


def _high_bit_first(polynomial: int, bits: int) -> tuple[NDArray[np.uint32], Step]:
    """Return the table (256,) of a CRC with the most significant bit first, and the function that appends a zero byte."""
    mask = np.uint32((1 << bits) - 1)
    table = np.arange(256, dtype=np.uint32) << np.uint32(bits - 8)
    for _ in range(8):
        table = np.where(table >> (bits - 1), (table << 1) ^ np.uint32(polynomial), table << 1) & mask

    def step(crc: NDArray[np.uint32], table: NDArray[np.uint32]) -> NDArray[np.uint32]:
        stepped: NDArray[np.uint32] = table[crc >> (bits - 8)] ^ ((crc << 8) & mask)
        return stepped

    return table, step


def _mixed_table(polynomial: int, bits: int) -> tuple[NDArray[np.uint32], Step]:
    """Return the table of `_high_bit_first` and the update function of `_low_bit_first`."""
    return _high_bit_first(polynomial, bits)[0], _step_low_bit_first


def _step_low_bit_first(crc: NDArray[np.uint32], table: NDArray[np.uint32]) -> NDArray[np.uint32]:
    stepped: NDArray[np.uint32] = table[crc & 0xFF] ^ (crc >> 8)
    return stepped
