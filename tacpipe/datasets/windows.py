"""Windows of recordings as a map-style torch dataset, for `torch.utils.data.DataLoader`."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from fnmatch import fnmatchcase
from functools import cached_property
from typing import TYPE_CHECKING, Literal, NamedTuple, TypedDict

import numpy as np
import torch

from tacpipe.arrays import AnyArray, Bools, Floats, Int64s
from tacpipe.channels import streams
from tacpipe.datasets import arrays
from tacpipe.errors import UsageError
from tacpipe.plugins.rows import IN_GAP, RowCounts, count_rows
from tacpipe.printable import listed, plain
from tacpipe.signals.contact import rest_level
from tacpipe.signals.runs import rows_in_windows, run_starts, window_starts

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording

KEPT_BYTES = 1 << 30  # maximum size of decoded recordings in memory, per process
TACTILE = "tactile"  # quantity of the channels with a level at rest


class Window(TypedDict):
    """One window. A loader stacks the tensors of several windows along a new first axis and lists their names."""

    past: torch.Tensor  # (context, input)
    future: torch.Tensor  # (horizon, target)
    t_ns: torch.Tensor  # int64 (context + horizon,), nanoseconds
    recording: str


class Scaling(NamedTuple):
    """Mean and standard deviation of each channel over all rows of windows; the latter is 1 for a constant channel."""

    mean: Floats  # (channel,)
    std: Floats  # (channel,)


class _Selection(NamedTuple):
    """Selected channels and their scaling."""

    positions: list[int] | None  # None for all channels
    scaling: Scaling | None

    def apply(self, values: torch.Tensor) -> torch.Tensor:
        """Return the selected channels of ``values`` (time, channel), scaled."""
        selected = values if self.positions is None else values[:, self.positions]
        if self.scaling is None:
            return selected
        mean, std = map(torch.from_numpy, self.scaling)
        return ((selected.double() - mean) / std).to(values.dtype)


class _RecordingRows(NamedTuple):
    """The rows of one recording."""

    values: torch.Tensor  # (time, channel), not scaled; relative to rest if the rest level is subtracted
    t_ns: torch.Tensor  # (time,)
    starts: Int64s  # (window,), first row of each window


class Windows(torch.utils.data.Dataset[Window]):
    """The windows of a dataset's recordings, ordered by recording name and time.

    ``len(windows)`` is their number; ``windows[i]`` is a mapping:

    =============  ==========================================================================
    ``past``       float32 or float64 ``(context, input)``, in the unit of the columns
    ``future``     the same type, ``(horizon, target)``
    ``t_ns``       int64 ``(context + horizon,)``: times of the rows in nanoseconds
    ``recording``  the name of the recording
    =============  ==========================================================================

    ``inputs`` and ``targets`` name the channels of the past and of the future, ``columns`` both. The default is all
    measured channels (`tacpipe.datasets.arrays.Arrays`). Windows consist of consecutive rows without a gap, according
    to the ``…_gap`` masks and ``t_ns``, and with finite numbers in every channel. No window crosses a gap or the end of
    a recording.

    Nothing is read before the first ``len`` or item. Then each recording is read and verified once to find its windows;
    up to 1 GiB of decoded recordings stays in memory. Windows can be pickled; each worker process of a loader reads for
    itself.
    """

    def __init__(
        self,
        dataset: Dataset,
        context: int,
        horizon: int,
        *,
        stream: str = "",
        columns: Sequence[str] | None = None,
        inputs: Sequence[str] | None = None,
        targets: Sequence[str] | None = None,
        rest_s: float | None = None,
        scale: bool | Windows = False,
        stride: int = 1,
        dtype: Literal["float32", "float64"] = "float32",
    ) -> None:
        """Prepare the windows that `Dataset.windows` describes; recordings are decoded when they are needed.

        Raises `UsageError` for invalid options.
        """
        window_starts(
            np.zeros(0), np.zeros(0, dtype=bool), context, horizon, stride
        )  # raises an error for lengths below 1
        if dtype not in ("float32", "float64"):
            raise UsageError(f"The dtype of windows is float32 or float64, not {dtype!r}.")
        if columns is not None and not (inputs is None and targets is None):
            raise UsageError("columns sets both inputs and targets. Give either columns, or inputs and targets.")
        if rest_s is not None and not rest_s > 0:
            raise UsageError(f"rest_s is {rest_s}; it must be a number of seconds above 0.")
        self.dataset, self.context, self.horizon, self.stride = dataset, context, horizon, stride
        self.stream, self.dtype, self.rest_s, self.scale = stream, dtype, rest_s, scale
        self._patterns = (inputs, targets) if columns is None else (columns, columns)
        self._names = list(dataset.recordings)
        self._ends: Int64s | None = None  # (recording,), cumulative number of windows
        self._channels: tuple[tuple[str, ...], tuple[str, ...]] | None = None  # inputs and targets
        self._scaling: Scaling | None = None
        self._cache: OrderedDict[str, _RecordingRows] = OrderedDict()

    def __len__(self) -> int:
        return int(self._index()[-1]) if self._names else 0

    def __getitem__(self, index: int) -> Window:
        """Return one window. Raises `IndexError` after the last."""
        count = len(self)
        if not -count <= index < count:
            raise IndexError(f"There are {count} windows, and none has the index {index}.")
        position = index % count
        ends = self._index()
        recording_index = int(np.searchsorted(ends, position, side="right"))
        name = self._names[recording_index]
        rows = self._rows(name)
        start = int(rows.starts[position - (int(ends[recording_index - 1]) if recording_index else 0)])
        split, stop = start + self.context, start + self.context + self.horizon
        return {
            "past": self._past.apply(rows.values[start:split]),
            "future": self._future.apply(rows.values[split:stop]),
            "t_ns": rows.t_ns[start:stop],
            "recording": name,
        }

    def __repr__(self) -> str:
        lengths = f"context={self.context}, horizon={self.horizon}, stride={self.stride}"
        return f"Windows of {len(self._names)} recordings ({lengths}, {self.dtype})"

    def __getstate__(self) -> object:
        return {**vars(self), "_cache": OrderedDict()}

    @property
    def columns(self) -> tuple[str, ...]:
        """The names of the channels: the inputs, then the targets that are not inputs."""
        return tuple(dict.fromkeys((*self.inputs, *self.targets)))

    @property
    def inputs(self) -> tuple[str, ...]:
        """The names of the channels of ``past``."""
        return self._names_of_channels()[0]

    @property
    def targets(self) -> tuple[str, ...]:
        """The names of the channels of ``future``."""
        return self._names_of_channels()[1]

    @property
    def scaling(self) -> Scaling | None:
        """The scaling of ``columns``, or None if windows are not scaled."""
        if self.scale is False:
            return None
        if self._scaling is None:
            self._index()
            self._scaling = self._statistics() if self.scale is True else self._from_other(self.scale)
        return self._scaling

    def unscaled(self, future: torch.Tensor) -> torch.Tensor:
        """Return targets (…, target), such as predictions, in their original unit."""
        if self.scaling is None:
            return future
        at = self._positions(self.targets)
        mean, std = (torch.from_numpy(values[at]).to(future) for values in self.scaling)
        return future * std + mean

    @cached_property
    def _past(self) -> _Selection:
        return self._selection(self.inputs)

    @cached_property
    def _future(self) -> _Selection:
        return self._selection(self.targets)

    def _selection(self, names: tuple[str, ...]) -> _Selection:
        at = self._positions(names)
        scaling = None if self.scaling is None else Scaling(self.scaling.mean[at], self.scaling.std[at])
        return _Selection(None if names == self.columns else at, scaling)

    def _positions(self, names: tuple[str, ...]) -> list[int]:
        places = {name: index for index, name in enumerate(self.columns)}
        return [places[name] for name in names]

    def _statistics(self) -> Scaling:
        """Return mean and standard deviation over all rows that are part of a window.

        Raises `UsageError` without windows.
        """
        count, mean, squares = 0, np.zeros(len(self.columns)), np.zeros(len(self.columns))
        for name in self._names:
            rows = self._rows(name)
            inside = rows_in_windows(rows.starts, self.context + self.horizon, len(rows.values))
            values = rows.values.numpy()[inside].astype(np.float64)
            if len(values):  # means and squares of two parts can be added
                difference = values.mean(axis=0) - mean
                total = count + len(values)
                squares += ((values - values.mean(axis=0)) ** 2).sum(axis=0) + difference**2 * count * len(
                    values
                ) / total
                mean, count = mean + difference * len(values) / total, total
        if not count:
            raise UsageError("These recordings have no windows, so the scale cannot be computed.")
        std = np.sqrt(squares / count)
        return Scaling(mean, np.where(std > 0, std, 1.0))

    def _from_other(self, source: Windows) -> Scaling:
        """Return the scaling of other windows for the channels of these.

        Raises `UsageError` if they lack a channel or scaling.
        """
        scaling = source.scaling
        if scaling is None:
            raise UsageError("The windows given as scale are not scaled themselves. Make them with scale=True.")
        missing = [name for name in self.columns if name not in source.columns]
        if missing:
            raise UsageError(
                f"The windows to scale by have no channel {plain(missing[0])}; give both the same channels."
            )
        at = source._positions(self.columns)
        return Scaling(scaling.mean[at], scaling.std[at])

    def _names_of_channels(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        if self._channels is None:
            self._index()
        return self._channels or ((), ())

    def _index(self) -> Int64s:
        if self._ends is None:
            self._ends = np.cumsum([len(self._rows(name).starts) for name in self._names], dtype=np.int64)
        return self._ends

    def _rows(self, name: str) -> _RecordingRows:
        """Return the rows of a recording, from memory if it was used recently."""
        rows = self._cache.pop(name, None) or self._decode_recording(self.dataset[name])
        self._cache[name] = rows  # moves it to the end as the most recently used
        while len(self._cache) > 1 and sum(_bytes(cached) for cached in self._cache.values()) > KEPT_BYTES:
            self._cache.popitem(last=False)
        return rows

    def _decode_recording(self, recording: Recording) -> _RecordingRows:
        """Return the decoded rows of a recording. Raises `UsageError` if its channels differ from those of the others."""
        table = recording.table(self.stream)
        t_ns = streams.times(table)
        all_columns = arrays.arrays_of_table(table)
        inputs, targets = (_matching(patterns, all_columns, recording.name) for patterns in self._patterns)
        if self._channels is None:
            self._channels = inputs, targets
        names = tuple(dict.fromkeys((*inputs, *targets)))
        if (inputs, targets) != self._channels:
            odd = sorted(set(names) ^ set(self.columns)) or list(names)
            raise UsageError(
                f"Recording {recording.name} does not have the same channels as the others, or lacks one: {odd[0]}. "
                f"Name the columns to read, as in windows({self.context}, {self.horizon}, columns=[…])."
            )
        matrix = arrays.Arrays(all_columns.by_column, names)
        if self.rest_s is None:
            values = _matrix(matrix, self.dtype, recording.name)
        else:
            values = _above_rest(table, matrix, t_ns, self.rest_s).astype(self.dtype)
        usable: Bools = ~streams.unusable_rows(table) & np.isfinite(values).all(axis=1)
        groups = np.cumsum(run_starts(t_ns, streams.max_step(recording.attributes)))
        starts = window_starts(groups, usable, self.context, self.horizon, self.stride)
        inside = rows_in_windows(starts, self.context + self.horizon, len(t_ns))
        count_rows(recording.name, self.stream, RowCounts.from_masks(inside, [(IN_GAP, ~usable)]))
        return _RecordingRows(torch.from_numpy(values), torch.from_numpy(t_ns.copy()), starts)


def _matching(patterns: Sequence[str] | None, read: arrays.Arrays, recording: str) -> tuple[str, ...]:
    """Return the columns with these names, and the channels that match these patterns; all channels without patterns.

    Raises `UsageError` for a pattern without a match.
    """
    if patterns is None:
        return read.columns
    names: list[str] = []
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        exact = [pattern] if pattern in read.by_column else []
        matching = exact or [name for name in read.columns if fnmatchcase(name, pattern)]
        if not matching:
            raise UsageError(
                f"Recording {recording} has no column {plain(pattern)}, and no channel matches it. Its channels are "
                f"{listed(read.columns)}."
            )
        names += matching
    return tuple(dict.fromkeys(names))


def _above_rest(table: pa.Table, matrix: arrays.Arrays, t_ns: Int64s, rest_s: float) -> Floats:
    """Return the channels (time, channel), tactile ones less their median over the first ``rest_s`` seconds.

    Raises `UsageError` if there is no tactile channel.
    """
    values = matrix.values.astype(np.float64)
    touch = np.isin(matrix.columns, streams.columns_with_quantity(table, TACTILE))  # (channel,)
    if not touch.any():
        raise UsageError(
            f"None of these channels has the quantity {TACTILE}, so none has a level at rest; leave out rest_s."
        )
    finite = np.isfinite(values[:, touch]).all(axis=1)
    if finite.any():
        values[:, touch] -= rest_level(values[finite][:, touch], t_ns[finite], rest_s)
    return values


def _matrix(channels: arrays.Arrays, dtype: str, name: str) -> AnyArray:
    """Return the channels as (time, channel). Raises `UsageError` if ``dtype`` would round an integer."""
    exact = channels.values
    values = exact.astype(dtype)
    if exact.dtype.kind in "iu" and exact.dtype.itemsize > 2 and not np.array_equal(values.astype(exact.dtype), exact):
        raise UsageError(
            f"Recording {name} holds integers that {dtype} would round. Give dtype='float64', or other columns."
        )
    return values


def _bytes(rows: _RecordingRows) -> int:
    return rows.values.nbytes + rows.t_ns.nbytes
