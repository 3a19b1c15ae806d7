"""Turn the packets of a link into frames. Each packet is one frame or none."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from tacpipe.arrays import Bools, Bytes
from tacpipe.sensors.framing import MALFORMED, Account, Chunks, Loss, Run


class PacketFramer:
    """Takes each packet of a link for a frame: those of a known size whose check is right."""

    def __init__(self, sizes: Sequence[int], check: Callable[[Bytes], Bools] | None = None) -> None:
        self.sizes, self.check = frozenset(sizes), check
        self.account = Account()

    def feed(self, chunks: Chunks) -> tuple[list[Run], list[Loss]]:
        """Return the packets that are frames, those of one size together, and the others as losses."""
        self.account.received += len(chunks.data)
        runs, losses = [], []
        starts = np.cumsum(chunks.size) - chunks.size
        edges = np.flatnonzero(np.diff(chunks.size)) + 1
        for rows in np.split(np.arange(len(chunks.size)), edges):
            if not len(rows):
                continue
            size, start = int(chunks.size[rows[0]]), int(starts[rows[0]])
            good = np.full(len(rows), size in self.sizes)
            frames = np.frombuffer(chunks.data, np.uint8, len(rows) * size, start).reshape(len(rows), size)
            if good[0] and self.check is not None:
                good &= self.check(frames)
            if good.any():
                runs.append(Run(frames if good.all() else frames[good], chunks.t_ns[rows[good]]))
            losses += [Loss(int(t_ns), MALFORMED, 1, size) for t_ns in chunks.t_ns[rows[~good]]]
            self.account.framed += int(good.sum()) * size
            self.account.lost += int((~good).sum()) * size
        return runs, losses

    def flush(self) -> tuple[list[Run], list[Loss]]:
        """Return nothing: a packet is whole or it is none."""
        return [], []
