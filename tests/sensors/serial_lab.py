"""Helpers for tests of serial drivers: bytes fed in pieces, and a pseudo-terminal with a device."""

import os
import select
import threading
import tty
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from tacpipe.arrays import AnyArray
from tacpipe.sensors.framing import Chunks, FramingLoss
from tacpipe.sensors.sensor import Samples, Sensor
from tacpipe.testing.dialogues import Device


def read(sensor: Sensor, data: bytes, sizes: Sequence[int] = (50,)) -> tuple[list[Samples], list[FramingLoss]]:
    """Return what a driver makes of bytes that come in pieces of these sizes over and over."""
    framer, samples, losses = sensor.framer(), [], []
    place, step = 0, 0
    while place < len(data):
        piece = data[place : place + sizes[step % len(sizes)]]
        runs, lost = framer.feed(Chunks.from_pairs([(step, piece)]))
        samples += [sensor.decode(run.frames) for run in runs]
        losses += lost
        place, step = place + len(piece), step + 1
    runs, lost = framer.flush()
    assert framer.account.pending == 0
    return samples + [sensor.decode(run.frames) for run in runs], losses + lost


def values(samples: Sequence[Samples]) -> list[AnyArray]:
    """Return the blocks of samples one after the other, each (sample, channel)."""
    non_empty = [batch for batch in samples if len(batch)]
    return [np.concatenate(blocks) for blocks in zip(*(batch.values for batch in non_empty), strict=True)]


def rows_of(samples: Sequence[Samples]) -> list[bytes]:
    """Return the values of each sample as bytes, to look one up among others."""
    blocks = values(samples)
    return [b"".join(block[row].tobytes() for block in blocks) for row in range(len(blocks[0]) if blocks else 0)]


def stream(frames: Any) -> bytes:
    """Return the bytes of frames."""
    return b"".join(bytes(frame) for frame in frames)


def streams(device: Device) -> bool:
    """Return whether a device streams now: a type checker takes what it saw before for what still holds."""
    return device.streaming


@contextmanager
def served(device: Device, frame: Callable[[int], bytes], period_s: float = 0.002) -> Iterator[str]:
    """Serve a device on a pseudo-terminal, whose path is given: replies, and frames of which ``frame`` gives each."""
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    stopped = threading.Event()

    def serve() -> None:
        sent = 0
        while not stopped.is_set():
            if select.select([master], [], [], period_s)[0]:
                for reply in device.hear(os.read(master, 4096)):
                    os.write(master, reply)
            for _ in range(device.polled() or int(device.streaming)):
                try:
                    os.write(master, frame(sent))
                except BlockingIOError:  # nobody reads: a real port loses bytes as well
                    continue
                sent += 1

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield os.ttyname(slave)
    finally:
        stopped.set()
        thread.join()
        os.close(master)
        os.close(slave)


class FakeSerial:
    """Bytes behind the methods of pyserial that vendors' parsers call; all that is there can be read at once."""

    is_open = True

    def __init__(self, data: bytes, read_limit: int = 1 << 30) -> None:
        self.data, self.place, self.read_limit = data, 0, read_limit

    @property
    def in_waiting(self) -> int:
        return min(self.read_limit, len(self.data) - self.place)

    def read(self, size: int = 1) -> bytes:
        chunk = self.data[self.place : self.place + min(size, self.read_limit)]
        self.place += len(chunk)
        return chunk

    def read_until(self, expected: bytes = b"\n") -> bytes:
        stop = self.data.find(expected, self.place)
        return self.read(stop + len(expected) - self.place if stop >= 0 else len(self.data))

    def write(self, data: bytes) -> int:
        return len(data)

    def flush(self) -> None: ...

    def reset_input_buffer(self) -> None: ...
