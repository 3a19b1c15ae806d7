"""Windows of recordings as a map-style torch dataset, for `torch.utils.data.DataLoader`."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypedDict

import numpy as np
import torch

from tacpipe.arrays import AnyArray, Int64s
from tacpipe.channels import masks
from tacpipe.datasets import arrays
from tacpipe.errors import UsageError
from tacpipe.signals.windows import breaks, window_starts

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Recording

KEPT_BYTES = 1 << 30  # of decoded recordings that stay in memory, in each process


class Window(TypedDict):
    """One window; a loader stacks the tensors of several along a first axis and lists their names."""

    past: torch.Tensor  # (context, channel), in the unit of the recording
    future: torch.Tensor  # (horizon, channel)
    t_ns: torch.Tensor  # int64 (context + horizon,), nanoseconds
    recording: str


class _Read(NamedTuple):
    """The rows of one recording."""

    values: torch.Tensor  # (time, channel)
    t_ns: torch.Tensor  # (time,)
    starts: Int64s  # (window,), first rows of the windows


class Windows(torch.utils.data.Dataset[Window]):
    """The windows of a dataset's recordings, one after another in the order of names and of time.

    ``len(windows)`` counts them; ``windows[i]`` is a mapping:

    =============  ==========================================================================
    ``past``       float32 or float64 ``(context, channel)``: counts, or what unit the column has
    ``future``     the same type, ``(horizon, channel)``
    ``t_ns``       int64 ``(context + horizon,)``: times of the rows in nanoseconds
    ``recording``  the name of the recording
    =============  ==========================================================================

    ``columns`` names the channels: those given, or all that were measured (`tacpipe.datasets.arrays.Arrays`). Rows that
    follow one another without a gap, by the ``…_gap`` masks and by ``t_ns``, and that hold a finite number in every channel
    make windows; no window crosses a gap or the end of a recording.

    Nothing is read before the first ``len`` or item. That reads and verifies each recording once, to find its windows;
    decoded recordings of up to 1 GiB stay in memory. It can be pickled, and worker processes of a loader read for
    themselves.
    """

    def __init__(
        self,
        dataset: Dataset,
        context: int,
        horizon: int,
        *,
        stream: str = "",
        columns: Sequence[str] | None = None,
        stride: int = 1,
        dtype: Literal["float32", "float64"] = "float32",
    ) -> None:
        window_starts(np.zeros(0), np.zeros(0, dtype=bool), context, horizon, stride)  # refuses lengths below 1
        if dtype not in ("float32", "float64"):
            raise UsageError(f"The dtype of windows is float32 or float64, not {dtype!r}.")
        self.dataset, self.context, self.horizon, self.stride = dataset, context, horizon, stride
        self.stream, self.dtype = stream, dtype
        self._asked = None if columns is None else tuple(dict.fromkeys(columns))
        self._names = list(dataset.recordings)
        self._ends: Int64s | None = None  # (recording,), windows up to the end of each
        self._columns: tuple[str, ...] | None = None
        self._kept: OrderedDict[str, _Read] = OrderedDict()

    def __len__(self) -> int:
        return int(self._index()[-1]) if self._names else 0

    def __getitem__(self, index: int) -> Window:
        """Return one window. Raises `IndexError` beyond the last."""
        count = len(self)
        if not -count <= index < count:
            raise IndexError(f"There are {count} windows, and none has the index {index}.")
        place = index % count
        ends = self._index()
        number = int(np.searchsorted(ends, place, side="right"))
        name = self._names[number]
        found = self._read(name)
        first = int(found.starts[place - (int(ends[number - 1]) if number else 0)])
        now, last = first + self.context, first + self.context + self.horizon
        return {
            "past": found.values[first:now],
            "future": found.values[now:last],
            "t_ns": found.t_ns[first:last],
            "recording": name,
        }

    def __repr__(self) -> str:
        lengths = f"context={self.context}, horizon={self.horizon}, stride={self.stride}"
        return f"Windows of {len(self._names)} recordings ({lengths}, {self.dtype})"

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_kept": OrderedDict()}

    @property
    def columns(self) -> tuple[str, ...]:
        """The names of the channels."""
        if self._columns is None:
            self._index()
        return self._columns or ()

    def _index(self) -> Int64s:
        if self._ends is None:
            self._ends = np.cumsum([len(self._read(name).starts) for name in self._names], dtype=np.int64)
        return self._ends

    def _read(self, name: str) -> _Read:
        found = self._kept.pop(name, None) or self._decoded(self.dataset[name])
        self._kept[name] = found  # as the one used last
        while len(self._kept) > 1 and sum(_bytes(one) for one in self._kept.values()) > KEPT_BYTES:
            self._kept.popitem(last=False)
        return found

    def _decoded(self, recording: Recording) -> _Read:
        table = recording.table(self.stream)
        t_ns = masks.times(table)
        read = arrays.of_table(table)
        names = read.columns if self._asked is None else self._asked
        if self._columns is None:
            self._columns = names
        missing = [name for name in names if name not in read.by_column]
        if missing or names != self._columns:
            odd = missing or sorted(set(names) ^ set(self._columns)) or list(names)
            raise UsageError(
                f"Recording {recording.name} has not the same channels as the others, or lacks one: {odd[0]}. Name the "
                f"columns to read, as in windows({self.context}, {self.horizon}, columns=[…])."
            )
        values = _matrix(arrays.Arrays(read.by_column, names), self.dtype, recording.name)
        usable = ~masks.gaps(table) & np.isfinite(values).all(axis=1)
        groups = np.cumsum(breaks(t_ns, masks.apart(recording.attributes)))
        starts = window_starts(groups, usable, self.context, self.horizon, self.stride)
        return _Read(torch.from_numpy(values), torch.from_numpy(t_ns.copy()), starts)


def _matrix(found: arrays.Arrays, dtype: str, name: str) -> AnyArray:
    """Return the channels as (time, channel). Raises `UsageError` where ``dtype`` would round a whole number."""
    exact = found.values
    values = exact.astype(dtype)
    if exact.dtype.kind in "iu" and exact.dtype.itemsize > 2 and not np.array_equal(values.astype(exact.dtype), exact):
        raise UsageError(
            f"Recording {name} holds whole numbers that {dtype} rounds. Give dtype='float64', or other columns."
        )
    return values


def _bytes(one: _Read) -> int:
    return one.values.nbytes + one.t_ns.nbytes
