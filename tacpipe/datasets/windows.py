"""Windows of recordings as a map-style torch dataset, for `torch.utils.data.DataLoader`."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Sequence
from fnmatch import fnmatchcase
from functools import cached_property
from typing import IO, TYPE_CHECKING, Literal, NamedTuple, NotRequired, TypedDict

import numpy as np
import torch

from tacpipe.arrays import AnyArray, Bools, Floats, Int64s
from tacpipe.channels import streams
from tacpipe.datasets import arrays
from tacpipe.datasets.window_images import WindowImages
from tacpipe.errors import UsageError
from tacpipe.io.row_groups import holds_bytes
from tacpipe.plugins.rows import IN_GAP, NO_IMAGE, RowCounts, count_rows
from tacpipe.printable import listed, plain
from tacpipe.signals.contact import rest_level
from tacpipe.signals.runs import rows_in_windows, run_starts, window_starts

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.reading import ReadableDataset, ReadableRecording
    from tacpipe.datasets.window_images import ImageOptions

KEPT_BYTES = 1 << 30  # maximum size of an array of decoded recordings in memory; a larger one is in a temporary file
TACTILE = "tactile"  # quantity of the channels with a level at rest


class Window(TypedDict):
    """One window. A loader stacks the tensors of several windows along a new first axis and lists their names."""

    past: torch.Tensor  # (context, input)
    future: torch.Tensor  # (horizon, target)
    t_ns: torch.Tensor  # int64 (context + horizon,), nanoseconds
    recording: str
    images: NotRequired[dict[str, torch.Tensor]]  # (context, colour, height, width) by camera


class Scaling(NamedTuple):
    """Mean and standard deviation of each channel over all rows of windows; the latter is 1 for a constant channel."""

    mean: Floats  # (channel,)
    std: Floats  # (channel,)


class _Selection(NamedTuple):
    """Selected channels and their scaling."""

    positions: list[int] | None  # None for all channels
    scaling: Scaling | None

    def apply(self, values: torch.Tensor) -> torch.Tensor:
        """Return the selected channels of ``values`` (…, channel), scaled."""
        selected = values if self.positions is None else values[..., self.positions]
        if self.scaling is None:
            return selected
        mean, std = map(torch.from_numpy, self.scaling)
        return ((selected.double() - mean) / std).to(values.dtype)


class _Decoded(NamedTuple):
    """The rows of all recordings, one recording after the other."""

    values: torch.Tensor  # (row, channel), not scaled; relative to rest if the rest level is subtracted
    t_ns: torch.Tensor  # (row,)
    rows: Int64s  # (recording,), cumulative number of rows
    starts: Int64s  # (window,), first row of each window
    windows: Int64s  # (recording,), cumulative number of windows
    images: WindowImages | None


class _GrowingArray:
    """Rows that are in memory up to `KEPT_BYTES`, and otherwise in a temporary file."""

    def __init__(self, empty: AnyArray) -> None:
        """Start without rows; ``empty`` has the type, and the width until rows are appended."""
        self._empty, self.rows = empty, 0
        self._parts: list[AnyArray] = []
        self._bytes = 0
        self._file: IO[bytes] | None = None

    def append(self, part: AnyArray) -> None:
        """Append rows, all of one type and width."""
        self._empty = part[:0]
        self._parts.append(np.ascontiguousarray(part))
        self.rows, self._bytes = self.rows + len(part), self._bytes + part.nbytes
        if self._bytes > KEPT_BYTES:
            self._file = self._file or tempfile.TemporaryFile()  # noqa: SIM115, `array` closes it
            for waiting in self._parts:
                waiting.tofile(self._file)
            self._parts.clear()

    def array(self) -> AnyArray:
        """Return all rows."""
        if self._file is None:
            return np.concatenate(self._parts) if self._parts else self._empty
        with self._file as file:  # the map keeps the removed file
            return np.memmap(file, self._empty.dtype, "r+", shape=(self.rows, *self._empty.shape[1:]))


class Windows(torch.utils.data.Dataset[Window]):
    """The windows of a dataset's recordings, ordered by recording name and time.

    ``len(windows)`` is their number; ``windows[i]`` is a mapping:

    =============  ==========================================================================
    ``past``       float32 or float64 ``(context, input)``, in the unit of the columns
    ``future``     the same type, ``(horizon, target)``
    ``t_ns``       int64 ``(context + horizon,)``: times of the rows in nanoseconds
    ``recording``  the name of the recording
    ``images``     uint8 ``(context, 3, height, width)`` by camera, if ``images`` names cameras
    =============  ==========================================================================

    ``inputs`` and ``targets`` name the channels of the past and of the future, ``columns`` both. The default is all
    measured channels (`tacpipe.datasets.arrays.Arrays`). Windows consist of consecutive rows without a gap, according
    to the ``…_gap`` masks and ``t_ns``, and with finite numbers in every channel. No window crosses a gap or the end of
    a recording.

    Nothing is read before the first ``len`` or item. Then each recording is read and verified once. Decoded recordings
    stay in memory, or from 1 GiB on in a temporary file, so items cost the same for any number of recordings. A loader
    gets the windows of a batch at once. Windows can be pickled; a process that unpickles them reads the recordings again.
    """

    def __init__(
        self,
        dataset: ReadableDataset,
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
        images: ImageOptions | None = None,
    ) -> None:
        """Prepare the windows that `Dataset.windows` describes; recordings are decoded when they are needed.

        Raises `UsageError` for invalid options.
        """
        window_starts(
            np.zeros(0), np.zeros(0, dtype=bool), context, horizon, stride
        )  # raises an error for wrong lengths
        if dtype not in ("float32", "float64"):
            raise UsageError(f"The dtype of windows is float32 or float64, not {dtype!r}.")
        if columns is not None and not (inputs is None and targets is None):
            raise UsageError("columns sets both inputs and targets. Give either columns, or inputs and targets.")
        if rest_s is not None and not rest_s > 0:
            raise UsageError(f"rest_s is {rest_s}; it must be a number of seconds above 0.")
        self.dataset, self.context, self.horizon, self.stride = dataset, context, horizon, stride
        self.stream, self.dtype, self.rest_s, self.scale = stream, dtype, rest_s, scale
        self._image_options = images
        self._patterns = (inputs, targets) if columns is None else (columns, columns)
        self._names = list(dataset.recordings)
        self._content: _Decoded | None = None
        self._channels: tuple[tuple[str, ...], tuple[str, ...]] | None = None  # inputs and targets
        self._scaling: Scaling | None = None

    def __len__(self) -> int:
        return len(self._decoded.starts)

    def __getitem__(self, index: int) -> Window:
        """Return one window. Raises `IndexError` after the last."""
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[Window]:
        """Return several windows, gathered at once. Raises `IndexError` after the last."""
        decoded, length = self._decoded, self.context + self.horizon
        positions = np.array(self._positions_of(indices), np.int64)
        rows = torch.from_numpy(decoded.starts[positions][:, None] + np.arange(length)).flatten()
        values = decoded.values.index_select(0, rows).view(len(positions), length, -1)
        t_ns = decoded.t_ns.index_select(0, rows).view(len(positions), length)
        past, future = self._past.apply(values[:, : self.context]), self._future.apply(values[:, self.context :])
        owners = np.searchsorted(decoded.windows, positions, side="right").tolist()
        items: list[Window] = [
            {"past": before, "future": after, "t_ns": times, "recording": self._names[owner]}
            for before, after, times, owner in zip(past.unbind(), future.unbind(), t_ns.unbind(), owners, strict=True)
        ]
        if decoded.images is not None:
            first_rows = np.append(0, decoded.rows)[owners]
            for item, owner, start in zip(items, owners, decoded.starts[positions] - first_rows, strict=True):
                item["images"] = decoded.images.read(owner, np.arange(start, start + self.context))
        return items

    def _positions_of(self, indices: Sequence[int]) -> list[int]:
        """Return the places of windows, counted from the first. Raises `IndexError` after the last."""
        count = len(self)
        for index in indices:
            if not -count <= index < count:
                raise IndexError(f"There are {count} windows, and none has the index {index}.")
        return [index % count for index in indices]

    def __repr__(self) -> str:
        lengths = f"context={self.context}, horizon={self.horizon}, stride={self.stride}"
        return f"Windows of {len(self._names)} recordings ({lengths}, {self.dtype})"

    def __getstate__(self) -> object:
        return {**vars(self), "_content": None}

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
        decoded = self._decoded
        inside = rows_in_windows(decoded.starts, self.context + self.horizon, len(decoded.t_ns))
        for first, stop in itertools.pairwise([0, *decoded.rows.tolist()]):
            values = decoded.values[first:stop].numpy()[inside[first:stop]].astype(np.float64)
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
            len(self)  # decoding finds the channels
        return self._channels or ((), ())

    @property
    def _decoded(self) -> _Decoded:
        """The rows of all recordings, which are read on first use."""
        if self._content is None:
            values = _GrowingArray(np.zeros((0, 0), self.dtype))
            t_ns = _GrowingArray(np.zeros(0, np.int64))
            rows, windows, starts = [], [], [np.zeros(0, np.int64)]
            images = None if self._image_options is None else WindowImages(self._image_options)
            for name in self._names:
                own_values, own_t_ns, own_starts = self._decode_recording(self.dataset[name], images)
                starts.append(own_starts + t_ns.rows)
                values.append(own_values)
                t_ns.append(own_t_ns)
                rows.append(len(own_t_ns))
                windows.append(len(own_starts))
            self._content = _Decoded(
                torch.from_numpy(values.array()),
                torch.from_numpy(t_ns.array()),
                np.cumsum(rows, dtype=np.int64),
                np.concatenate(starts),
                np.cumsum(windows, dtype=np.int64),
                images,
            )
        return self._content

    def _decode_recording(
        self, recording: ReadableRecording, images: WindowImages | None
    ) -> tuple[AnyArray, Int64s, Int64s]:
        """Return values (row, channel), times (row,) and first rows of windows (window,) of a recording.

        Its frames are added to ``images``.

        Raises `UsageError` if its channels differ from those of the others.
        """
        stored = recording.columns(self.stream)
        table = stored.read([field.name for field in stored.schema if not holds_bytes(field)])
        t_ns = streams.times(table)
        all_columns = arrays.arrays_of_table(table)
        inputs, targets = (_matching(patterns, all_columns, recording.name) for patterns in self._patterns)
        if self._channels is None:
            self._channels = inputs, targets
        names = tuple(dict.fromkeys((*inputs, *targets)))
        if (inputs, targets) != self._channels:
            odd = sorted(set(names) ^ {*self._channels[0], *self._channels[1]}) or list(names)
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
        reasons = [(IN_GAP, ~usable)]
        if images is not None:
            has_image = images.add(recording, t_ns)
            reasons.append((NO_IMAGE, ~has_image))
            usable &= has_image
        groups = np.cumsum(run_starts(t_ns, streams.max_step(recording.attributes)))
        starts = window_starts(groups, usable, self.context, self.horizon, self.stride)
        inside = rows_in_windows(starts, self.context + self.horizon, len(t_ns))
        count_rows(recording.name, self.stream, RowCounts.from_masks(inside, reasons))
        return values, t_ns, starts


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
