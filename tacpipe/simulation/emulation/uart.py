"""Compute the bytes that a serial port receives at another speed than the device sends."""

from __future__ import annotations

import numpy as np

IDLE_BITS = 30  # number of idle bits after the last byte


def garbled(data: bytes, sent_baud: int, read_baud: int) -> bytes:
    """Return what is read at ``read_baud`` of bytes that were sent at ``sent_baud``, 8 bits, no parity, one stop bit.

    A byte begins where the line falls; where no stop bit is found, it is kept all the same, as Linux does by default.

    >>> garbled(b"touch", 9600, 9600)
    b'touch'
    >>> garbled(b"UUUU", 9600, 19200) == b"UUUU"
    False
    """
    bits = np.unpackbits(np.frombuffer(data, np.uint8)[:, None], axis=1, bitorder="little")  # (byte, bit)
    framed = np.hstack([np.zeros((len(bits), 1), np.uint8), bits, np.ones((len(bits), 1), np.uint8)])
    line = np.append(framed.ravel(), np.ones(IDLE_BITS + round(12 * sent_baud / read_baud), np.uint8))
    width = sent_baud / read_baud  # length of a received bit in sent bits
    middles = (1.5 + np.arange(8)) * width
    low = np.flatnonzero(line == 0)
    received, place = [], 0.0
    while (row := int(np.searchsorted(low, np.floor(place)))) < len(low):
        start = max(place, float(low[row]))
        received.append(np.packbits(line[np.floor(start + middles).astype(int)], bitorder="little")[0])
        place = start + 9.5 * width
        if place >= len(line) - 12 * width:
            break
    return bytes(received)
