"""The rows that a codec is fitted on, recording by recording."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.codecs import codec, measures, tactile
from tacpipe.codecs.codec import check_channels
from tacpipe.datasets import splits
from tacpipe.errors import TacpipeError

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Recording
    from tacpipe.io.columns import Columns


HELD_OUT = 0.15  # fraction of the training recordings that a codec is measured on
log = logging.getLogger(__name__)


class CodecRows(Protocol):
    """Rows that codecs are fitted on, by recording: finite, in contact, and outside of gaps."""

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
        """Yield the rows (row, frames * channel) of some recordings, in the order of their names and of time, in pieces."""


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
        """The recordings to measure a codec on, as `held_out` chooses them."""
        return held_out(self.names)

    @property
    def parts(self) -> tuple[AnyFloats, AnyFloats]:
        """The rows of the recordings that are not held out, and of those that are."""
        return self.of(self.inputs.keys() - self.held_out), self.of(self.held_out)

    def of(self, names: Collection[str]) -> AnyFloats:
        """Return the rows (row, frames * channel) of some recordings, in the order of their names."""
        width = max(rows.shape[1] for rows in self.inputs.values())
        return np.concatenate([np.zeros((0, width)), *self.pieces(names)])

    def pieces(self, names: Collection[str]) -> Iterator[AnyFloats]:
        """Yield the rows of each of some recordings, in the order of their names."""
        return (self.inputs[name] for name in sorted(names))


@dataclass(frozen=True)
class StoredRows:
    """The rows of all recordings, which are read each time that they are asked for: a piece of one is in memory."""

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
        """Yield the rows of some recordings, in the order of their names and of time, in pieces.

        Raises `TacpipeError` naming the recording whose channels are others.
        """
        for name in sorted(names):
            try:
                yield from self._pieces(self.recordings[name].columns())
            except TacpipeError as error:
                raise TacpipeError(f"{name}: {error}") from error

    def read(self) -> TrainingRows:
        """Return the rows of all recordings. Warns of channels that never move while others do."""
        inputs = {name: np.concatenate([self._none, *self.pieces([name])]) for name in sorted(self.names)}
        rows = TrainingRows(self.channels, self.layout, inputs)
        newest = rows.of(rows.names)[:, -len(self.channels) :]
        if len(newest) > 1:
            warn_of_still(measures.unmoving_channels(newest, self.channels), len(self.channels))
        return rows

    @property
    def _none(self) -> AnyFloats:
        return np.zeros((0, self.frames * len(self.channels)))

    def _pieces(self, stored: Columns) -> Iterator[AnyFloats]:
        """Yield the rows of a recording that a codec may be fitted on."""
        check_channels(self.channels, tactile.columns(stored.schema, "tactile"))
        begins, gaps = codec.run_starts(tactile.times(stored)), tactile.gap_mask(stored)
        in_contact = np.ones(len(begins), dtype=bool)
        if "contact" in stored.column_names:
            in_contact = stored.column("contact").to_numpy() >= 0
        stored.forget()
        stacking, row = codec.Stacking(self.representation, self.frames), 0
        for table in stored.batches(self.channels):
            now = slice(row, row + table.num_rows)
            counts = tactile.above_rest(table, self.channels)
            counts[gaps[now]] = np.nan  # results of such a row are not finite either
            stacked = stacking.next(counts, begins[now])
            yield stacked[np.isfinite(stacked).all(axis=1) & in_contact[now]]
            row += table.num_rows


def held_out(names: Collection[str]) -> frozenset[str]:
    """Return the recordings to measure a codec on: always the same ones of the same recordings, so that errors compare.

    At least one, and none where there is one recording alone.
    """
    if len(names) < 2:
        return frozenset()
    scheme = splits.Scheme(val=max(HELD_OUT, 1 / len(names)), test=0.0)
    roles = splits.assign({name: {} for name in names}, scheme)
    return frozenset(name for (name, _), role in roles.items() if role == "val")


def stored(recordings: Mapping[str, Recording], representation: str, frames: int = 1) -> StoredRows:
    """Return the rows of recordings that a codec of a ``representation`` and some ``frames`` is fitted on.

    A row counts where it lies in contact and all frames that it is made of are finite and outside of gaps. Raises
    `TacpipeError` if there is no recording or no tactile channel.
    """
    codec.check_representation(representation)
    if not recordings:
        raise TacpipeError("There is no training recording to fit a codec on. Make a split that has some.")
    schema = recordings[min(recordings)].columns().schema
    channels = tactile.columns(schema, "tactile")
    if not channels:
        raise TacpipeError("The recordings have no tactile channel (field metadata quantity=tactile) to compress.")
    return StoredRows(channels, tuple(tactile.layout(schema, channels)), recordings, representation, frames)


def read(recordings: Mapping[str, Recording], representation: str, frames: int = 1) -> TrainingRows:
    """Return the rows that `stored` returns, read: all are in memory.

    Warns of channels that never move while others do. Raises `TacpipeError` as `stored`, and naming the recording whose
    channels are others.
    """
    return stored(recordings, representation, frames).read()


def warn_of_still(names: Sequence[str], channels: int) -> None:
    """Log the names of channels, of so many, that have one value in all training rows, unless all do."""
    if 0 < len(names) < channels:
        log.warning(
            "%d of %d tactile channels never move in the training recordings: %s. Their taxels may be dead; a codec "
            "gives them back as they were here.",
            len(names),
            channels,
            ", ".join(names),
        )
