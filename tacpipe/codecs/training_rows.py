"""The rows that a codec is fitted on, recording by recording."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.codecs import frame_stacking, standard, tactile
from tacpipe.codecs.codec import check_channels
from tacpipe.datasets import splits
from tacpipe.errors import TacpipeError

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Recording

    Floats = np.ndarray[Any, np.dtype[np.floating[Any]]]

HELD_OUT = 0.15  # fraction of the training recordings that a codec is measured on
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrainingRows:
    """What codecs read of rows in contact that no gap touches and that are finite, by recording."""

    channels: tuple[str, ...]
    layout: tuple[Mapping[str, str], ...]
    inputs: Mapping[str, Floats]  # (row, frames * channel), in counts, newest frame last

    @property
    def held_out(self) -> frozenset[str]:
        """The recordings to measure a codec on: always the same ones of the same recordings, so that errors compare.

        At least one, and none where there is one recording alone.
        """
        count = len(self.inputs)
        if count < 2:
            return frozenset()
        scheme = splits.Scheme(val=max(HELD_OUT, 1 / count), test=0.0)
        roles = splits.assign({name: {} for name in self.inputs}, scheme)
        return frozenset(name for (name, _), role in roles.items() if role == "val")

    @property
    def parts(self) -> tuple[Floats, Floats]:
        """The rows of the recordings that are not held out, and of those that are."""
        return self.of(self.inputs.keys() - self.held_out), self.of(self.held_out)

    def of(self, names: Collection[str]) -> Floats:
        """Return the rows (row, frames * channel) of some recordings, in the order of their names."""
        width = max(rows.shape[1] for rows in self.inputs.values())
        return np.concatenate([np.zeros((0, width)), *(self.inputs[name] for name in sorted(names))])


def read(shards: Mapping[str, Recording], representation: str, frames: int = 1) -> TrainingRows:
    """Return the rows of recordings that a codec of a ``representation`` and some ``frames`` is fitted on.

    A row counts where it lies in contact and all frames that it is made of are finite and outside of gaps. Warns of
    channels that never move while others do. Raises `TacpipeError` where there is no recording or no tactile channel,
    and naming the recording whose channels are others.
    """
    frame_stacking.check(representation)
    if not shards:
        raise TacpipeError("There is no training recording to fit a codec on. Make a split that has some.")
    channels: tuple[str, ...] | None = None
    layout: tuple[Mapping[str, str], ...] = ()
    inputs: dict[str, Floats] = {}
    for name, shard in sorted(shards.items()):
        table = shard.table()
        found = tactile.columns(table.schema, "tactile")
        if channels is None:
            channels, layout = found, tuple(tactile.layout(table.schema, found))
        try:
            check_channels(channels, found)
            inputs[name] = _usable(table, channels, representation, frames)
        except TacpipeError as error:
            raise TacpipeError(f"{name}: {error}") from error
    if not channels:
        raise TacpipeError("The recordings have no tactile channel (field metadata quantity=tactile) to compress.")
    rows = TrainingRows(channels, layout, inputs)
    _warn_of_still(rows)
    return rows


def _usable(table: pa.Table, channels: tuple[str, ...], representation: str, frames: int) -> Floats:
    """Return the rows (row, frames * channel) of a recording that a codec may be fitted on."""
    counts = tactile.above_rest(table, channels)
    counts[tactile.gaps(table)] = np.nan  # what is made of such a row is not finite either
    made = frame_stacking.inputs(counts, frame_stacking.breaks(tactile.times(table)), representation, frames)
    usable = np.isfinite(made).all(axis=1)
    if "contact" in table.column_names:
        usable &= table.column("contact").to_numpy() >= 0
    return made[usable]


def _warn_of_still(rows: TrainingRows) -> None:
    """Log the channels that have one value in all rows, unless all do."""
    newest = rows.of(rows.inputs.keys())[:, -len(rows.channels) :]
    names = standard.still(newest, rows.channels)
    if len(newest) > 1 and 0 < len(names) < len(rows.channels):
        log.warning(
            "%d of %d tactile channels never move in the training recordings: %s. Their taxels may be dead; a codec "
            "gives them back as they were here.",
            len(names),
            len(rows.channels),
            ", ".join(names),
        )
