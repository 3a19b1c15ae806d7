"""The error sums of one result, as ``errors.parquet`` holds them, in arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Int64s
from tacpipe.errors import TacpipeError

if TYPE_CHECKING:
    import pyarrow as pa


FILE = "errors.parquet"
COLUMNS = (
    "recording",
    "known",
    "seen",
    "predictor",
    "group",
    "step",
    "windows",
    "channels",
    "squared",
    "absolute",
)


@dataclass(frozen=True)
class ErrorSums:
    """Sums over windows and channels; NaN where a predictor has no errors in a group of channels."""

    predictors: tuple[str, ...]
    groups: tuple[str, ...]
    recordings: tuple[str, ...]  # that the model was not trained on
    steps: tuple[int, ...]
    known: Bools  # (recording,): other recordings of its object were trained on
    windows: Int64s  # (recording,)
    channels: Mapping[str, int]  # by group
    squared: AnyFloats  # (predictor, group, recording, step)
    absolute: AnyFloats  # (predictor, group, recording, step)
    named: bool = True  # whether any recording names its object: else none is known or unseen
    objects: Mapping[str, str] = field(default_factory=dict)  # recording to its object, if it names one

    def of(self, predictor: str, group: str) -> tuple[AnyFloats, AnyFloats] | None:
        """Return squared and absolute sums, both (recording, step); None where there are none."""
        if predictor not in self.predictors or group not in self.groups:
            return None
        at = self.predictors.index(predictor), self.groups.index(group)
        squared, absolute = self.squared[at], self.absolute[at]
        return None if np.isnan(squared).any() else (squared, absolute)


def read(content: bytes) -> ErrorSums:
    """Return the sums that a file holds, without those of recordings that the model was trained on.

    Raises `TacpipeError` where a column is missing, or where predictors were not evaluated on the same windows.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    from tacpipe.io.parquet import owned

    schema = pq.read_schema(pa.BufferReader(owned(content)))
    missing = [name for name in COLUMNS if name not in schema.names]
    if missing:
        raise TacpipeError(f"{FILE} has no column {' and no '.join(missing)}. Evaluate the model again.")
    objects = ["object"] if "object" in schema.names else []
    table = pq.read_table(pa.BufferReader(owned(content)), columns=[*COLUMNS, *objects])
    table = table.filter(np.logical_not(table["seen"].to_numpy()))
    named = not objects or table["object"].null_count < table.num_rows or not table.num_rows
    (predictors, predictor), (groups, group), (recordings, recording) = (
        _coded(table[name]) for name in ("predictor", "group", "recording")
    )
    steps, step = np.unique(table["step"].to_numpy(), return_inverse=True)
    windows = np.zeros(len(recordings), dtype=np.int64)
    windows[recording] = table["windows"].to_numpy()
    uneven = np.flatnonzero(windows[recording] != table["windows"].to_numpy())
    if len(uneven):
        raise TacpipeError(
            f"In {FILE}, predictors were evaluated on different windows of {recordings[recording[uneven[0]]]}, so they "
            f"cannot be compared. Evaluate the model again."
        )
    known = np.zeros(len(recordings), dtype=np.bool_)
    known[recording] = table["known"].to_numpy()
    sums = np.full((2, len(predictors), len(groups), len(recordings), len(steps)), np.nan)
    for index, name in enumerate(("squared", "absolute")):
        sums[index, predictor, group, recording, step] = table[name].to_numpy()
    return ErrorSums(
        predictors,
        groups,
        recordings,
        tuple(int(one) for one in steps),
        known,
        windows,
        {groups[code]: int(width) for code, width in zip(group, table["channels"].to_numpy(), strict=True)},
        sums[0],
        sums[1],
        named,
        _objects(table) if objects else {},
    )


def _objects(table: pa.Table) -> dict[str, str]:
    """Return the object that each recording names."""
    pairs = zip(table["recording"].to_pylist(), table["object"].to_pylist(), strict=True)
    return {recording: name for recording, name in pairs if name is not None}


def _coded(column: pa.ChunkedArray) -> tuple[tuple[str, ...], Int64s]:
    """Return the distinct values of a text column in the order in which they come, and the place of each row's."""
    encoded = column.combine_chunks().dictionary_encode()
    return tuple(encoded.dictionary.to_pylist()), encoded.indices.to_numpy().astype(np.int64)
