"""Select the rows of recordings that a codec is fitted on."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.channels import streams
from tacpipe.codecs import codec, measures, tactile
from tacpipe.codecs.codec import check_channels
from tacpipe.datasets import splits
from tacpipe.datasets.dataset import Recording
from tacpipe.errors import TacpipeError
from tacpipe.io.columns import Columns
from tacpipe.plugins.rows import IN_GAP, NO_CONTACT, RowCounts, count_rows

HELD_OUT = 0.15  # fraction of the training recordings that measure a codec
log = logging.getLogger(__name__)


class CodecRows(Protocol):
    """Rows for fitting a codec, by recording: finite, in contact, and outside of gaps."""

    @property
    def channels(self) -> tuple[str, ...]:
        """The tactile channels."""

    @property
    def layout(self) -> tuple[Mapping[str, str], ...]:
        """Stream, taxel and axis of each channel."""

    @property
    def names(self) -> Collection[str]:
        """The names of all recordings."""

    def pieces(self, names: Collection[str]) -> Iterator[AnyFloats]:
        """Yield the rows (row, frames * channel) of some recordings in chunks, ordered by name and time."""


@dataclass(frozen=True)
class TrainingRows:
    """The rows of all recordings, in memory."""

    channels: tuple[str, ...]
    layout: tuple[Mapping[str, str], ...]
    inputs: Mapping[str, AnyFloats]  # (row, frames * channel), in counts, newest frame last

    @property
    def names(self) -> Collection[str]:
        """The names of all recordings."""
        return self.inputs.keys()

    @property
    def held_out(self) -> frozenset[str]:
        """The names of the recordings that measure a codec, see `held_out`."""
        return held_out(self.names)

    @property
    def parts(self) -> tuple[AnyFloats, AnyFloats]:
        """The rows (row, frames * channel) of the recordings that are not held out, and of those that are."""
        return self.select(self.inputs.keys() - self.held_out), self.select(self.held_out)

    def select(self, names: Collection[str]) -> AnyFloats:
        """Return the rows (row, frames * channel) of some recordings, ordered by name."""
        width = max(rows.shape[1] for rows in self.inputs.values())
        return np.concatenate([np.zeros((0, width)), *self.pieces(names)])

    def pieces(self, names: Collection[str]) -> Iterator[AnyFloats]:
        """Yield the rows (row, frames * channel) of each recording in ``names``, ordered by name."""
        return (self.inputs[name] for name in sorted(names))


@dataclass(frozen=True)
class StoredRows:
    """The rows of all recordings, read again at each access; only a chunk of one recording is in memory."""

    channels: tuple[str, ...]
    layout: tuple[Mapping[str, str], ...]
    recordings: Mapping[str, Recording]
    representation: str
    frames: int = 1

    @property
    def names(self) -> Collection[str]:
        """The names of all recordings."""
        return self.recordings.keys()

    def pieces(self, names: Collection[str]) -> Iterator[AnyFloats]:
        """Yield chunks of rows (row, frames * channel) of the recordings in ``names``, ordered by name and time.

        Raises `TacpipeError` with the name of a recording whose channels differ.
        """
        for name in sorted(names):
            try:
                yield from self._pieces(name, self.recordings[name].columns())
            except TacpipeError as error:
                raise TacpipeError(f"{name}: {error}") from error

    def read(self) -> TrainingRows:
        """Return the rows of all recordings, read into memory. Warns of constant channels, unless all are.

        Raises the errors of `pieces`.
        """
        inputs = {name: np.concatenate([self._empty, *self.pieces([name])]) for name in sorted(self.names)}
        rows = TrainingRows(self.channels, self.layout, inputs)
        newest = rows.select(rows.names)[:, -len(self.channels) :]
        if len(newest) > 1:
            warn_of_constant_channels(measures.constant_channels(newest, self.channels), len(self.channels))
        return rows

    @property
    def _empty(self) -> AnyFloats:
        return np.zeros((0, self.frames * len(self.channels)))

    def _pieces(self, name: str, stored: Columns) -> Iterator[AnyFloats]:
        """Yield chunks of the rows (row, frames * channel) of a recording that are suitable for fitting a codec.

        Raises `TacpipeError` if its channels differ.
        """
        check_channels(self.channels, tactile.columns(stored.schema, "tactile"))
        begins, gaps = codec.run_starts(tactile.times(stored)), streams.unusable_rows(stored)
        in_contact = np.ones(len(begins), dtype=bool)
        if "contact" in stored.column_names:
            in_contact = stored.column("contact").to_numpy() >= 0
        stored.forget()
        stacking, row, used = codec.Stacking(self.representation, self.frames), 0, np.zeros(len(begins), dtype=bool)
        for table in stored.batches(self.channels):
            chunk = slice(row, row + table.num_rows)
            counts = tactile.above_rest(table, self.channels)
            counts[gaps[chunk]] = np.nan  # makes all results of such a row NaN
            stacked = stacking.next(counts, begins[chunk])
            used[chunk] = np.isfinite(stacked).all(axis=1) & in_contact[chunk]
            yield stacked[used[chunk]]
            row += table.num_rows
        count_rows(name, "", RowCounts.from_masks(used, [(NO_CONTACT, ~in_contact)], IN_GAP))


def held_out(names: Collection[str]) -> frozenset[str]:
    """Return the names of the recordings that measure a codec: at least one, or none if there is only one recording.

    The same names give the same choice, so that errors compare.
    """
    if len(names) < 2:
        return frozenset()
    scheme = splits.Scheme(val=max(HELD_OUT, 1 / len(names)), test=0.0)
    roles = splits.assign({name: {} for name in names}, scheme)
    return frozenset(name for (name, _), role in roles.items() if role == "val")


def stored_rows(recordings: Mapping[str, Recording], representation: str, frames: int = 1) -> StoredRows:
    """Return the rows of recordings for fitting a codec with this ``representation`` and number of ``frames``.

    A row is used if it is in contact and all its frames are finite and outside of gaps. Raises `TacpipeError` if there
    are no recordings or no tactile channels.
    """
    codec.check_representation(representation)
    if not recordings:
        raise TacpipeError("There is no training recording to fit a codec on. Make a split with some.")
    schema = recordings[min(recordings)].columns().schema
    channels = tactile.columns(schema, "tactile")
    if not channels:
        raise TacpipeError("The recordings have no tactile channel (field metadata quantity=tactile) to compress.")
    return StoredRows(channels, tuple(tactile.layout(schema, channels)), recordings, representation, frames)


def read_rows(recordings: Mapping[str, Recording], representation: str, frames: int = 1) -> TrainingRows:
    """Return the rows of `stored_rows`, read into memory.

    Warns of constant channels, unless all are. Raises `TacpipeError` as `stored_rows`, and with the name of a recording
    whose channels differ.
    """
    return stored_rows(recordings, representation, frames).read()


def warn_of_constant_channels(names: Sequence[str], channels: int) -> None:
    """Log the names of constant channels, unless all ``channels`` are constant."""
    if 0 < len(names) < channels:
        log.warning(
            "%d of %d tactile channels never move in the training recordings: %s. Their taxels may be dead; a codec "
            "reconstructs them as constants.",
            len(names),
            channels,
            ", ".join(names),
        )
