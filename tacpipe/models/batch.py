"""A batch of which several processes compute a part each: what layers draw for all of it and average over all of it.

Rows of a batch pass through most layers independently of each other; those need nothing of this. In a process that computes
whole batches each function does what torch's own does, to the bit.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class Rows:
    """Which dimension of what a network is given, and of each tensor that it returns, counts the rows of the batch.

    A network with such an attribute, ``ROWS``, can be computed in parts by several processes.
    """

    given: int
    returned: tuple[int, ...]


@dataclass(frozen=True)
class Part:
    """The rows of a batch that this process computes."""

    first: int
    count: int
    whole: int  # rows of the batch
    sum: Callable[[Tensor], Tensor]  # over all processes; gradients pass


_part: ContextVar[Part | None] = ContextVar("part", default=None)


@contextlib.contextmanager
def computing(part: Part) -> Iterator[None]:
    """Have layers in the block given these rows alone."""
    before = _part.set(part)
    try:
        yield
    finally:
        _part.reset(before)


def total(values: Tensor) -> Tensor:
    """Return values that were summed over the rows of this process, summed over the rows of the batch."""
    part = _part.get()
    return values if part is None else part.sum(values)


def count(rows: int) -> int:
    """Return how many there are in the batch of what this process has ``rows`` of, as many for each row of the batch."""
    part = _part.get()
    return rows if part is None else rows * part.whole // part.count


def mean(values: Tensor) -> Tensor:
    """Return the mean over the first dimension, over all rows of the batch."""
    return values.mean(dim=0) if _part.get() is None else total(values.sum(dim=0)) / count(len(values))


def dropout(values: Tensor, probability: float, training: bool, *, rows: int = 0) -> Tensor:
    """Return what dropout leaves of values, whose dimension ``rows`` is the batch's.

    It is drawn for the whole batch: the same in any number of processes, whose generators stay alike.
    """
    part = _part.get()
    if part is None or not training:
        return nn.functional.dropout(values, probability, training)
    shape = list(values.shape)
    shape[rows] = part.whole
    kept = nn.functional.dropout(values.new_ones(shape), probability)
    return values * kept.narrow(rows, part.first, part.count)


class Dropout(nn.Dropout):
    """`torch.nn.Dropout` by `dropout`."""

    def __init__(self, probability: float, *, rows: int = 0) -> None:
        super().__init__(probability)
        self.rows = rows

    def forward(self, input: Tensor) -> Tensor:
        """Return what dropout leaves of the values."""
        return dropout(input, self.p, self.training, rows=self.rows)


class BatchNorm1d(nn.BatchNorm1d):
    """`torch.nn.BatchNorm1d` of (row, channel) over all rows of the batch."""

    def forward(self, input: Tensor) -> Tensor:
        """Return the normalised values, and let the running means follow."""
        if _part.get() is None or not self.training:
            return super().forward(input)
        centre = mean(input)
        centred = input - centre
        variance, rows = mean(centred.square()), count(len(input))
        with torch.no_grad():
            assert self.running_mean is not None and self.running_var is not None and self.momentum is not None
            assert self.num_batches_tracked is not None
            self.num_batches_tracked.add_(1)
            self.running_mean.lerp_(centre, self.momentum)
            self.running_var.lerp_(variance * (rows / max(rows - 1, 1)), self.momentum)
        return centred * torch.rsqrt(variance + self.eps) * self.weight + self.bias
