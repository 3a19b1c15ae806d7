"""Select and convert the columns of a file by the rules of a stream."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, get_args

import numpy as np
import pyarrow as pa

from tacpipe.channels.schema import field_metadata
from tacpipe.errors import TacpipeError
from tacpipe.formats.container import natural_order
from tacpipe.formats.table import pattern
from tacpipe.formats.table.layout import ColumnRule, Kind, StreamLayout
from tacpipe.printable import listed, plain

TIME = "t_ns"
MAX_EXACT = 2**53  # number up to which float64 holds all whole numbers
_SPECIAL_TYPES = {"bool": pa.bool_(), "text": pa.string()}  # types whose names in Arrow differ from those in a layout
TYPES = {name: _SPECIAL_TYPES.get(name) or getattr(pa, name)() for name in get_args(Kind)}
Declared = Mapping[str, pa.Field]  # field with type and metadata by column name
NO_DECLARATION: Declared = {}


@dataclass(frozen=True)
class ChosenColumn:
    """A selected column: its name in the file, its field, and the matching rule."""

    name: str
    field: pa.Field
    rule: ColumnRule

    @property
    def read_as(self) -> pa.DataType:
        """The type for parsing cells: 64 bits for floats, because they may be scaled."""
        return pa.float64() if pa.types.is_floating(self.field.type) else self.field.type


class RowFile(Protocol):
    """A file of rows, or a stream of rows in a container."""

    path: Path

    def names(self) -> list[str]:
        """Return the names of the columns."""

    def batches(self, types: Mapping[str, pa.DataType]) -> Iterator[pa.Table]:
        """Return the columns in ``types``, block by block."""

    def place(self, index: int) -> str:
        """Return the name of the row ``index`` (from 0) in errors."""
        return f"row {index + 1}"


class CellError(ValueError):
    """An invalid value: the index of its row, and the reason."""

    def __init__(self, row: int, text: str) -> None:
        super().__init__(text)
        self.row = row


def choose_columns(
    stream: StreamLayout,
    names: Sequence[str],
    path: Path,
    declared: Declared = NO_DECLARATION,
    notes: list[str] | None = None,
) -> list[ChosenColumn]:
    """Return the columns to read among those in ``path``, in one order for all files: by rule, then by placeholders.

    ``declared`` are the fields that the file describes. They apply to columns without a matching rule; a rule replaces
    only the properties that it sets. A name without a column becomes a note, because some recordings of a lab may lack a
    column. Raises `TacpipeError` for a column without a description, another rule without a match, and duplicate names.
    """
    if declared:
        return _choose_columns(stream, names, path, declared, lacks_allowed=False)[0]
    chosen_columns, lacking = _choose_undeclared(stream, tuple(names), path, lacks_allowed=notes is not None)
    if lacking and notes is not None:
        notes.append(f"{stream.name} has no column {listed(lacking, 3)}.")
    return list(chosen_columns)


def _choose_columns(
    stream: StreamLayout,
    names: Sequence[str],
    path: Path,
    declared: Declared = NO_DECLARATION,
    *,
    lacks_allowed: bool,
) -> tuple[list[ChosenColumn], list[str]]:
    """Return the columns as `choose_columns` does, and the names in the layout without a column, if they are allowed."""
    chosen_columns: list[ChosenColumn] = []
    used = set()
    for name in names:
        matches = ((rule, pattern.match(rule.match, name)) for rule in stream.columns)
        rule, values = next(((rule, values) for rule, values in matches if values is not None), (None, {}))
        if rule is None or values is None:
            if name not in declared:
                raise TacpipeError(
                    f"{path} has a column {plain(name)}, which no entry of [streams.{stream.name}] columns matches. "
                    f'Add {{ match = "{plain(name)}", quantity = "…" }} or {{ match = "{plain(name)}", skip = true }}.'
                )
            rule, values = ColumnRule(match=name), {}
        used.add(rule)
        if not rule.skip:
            chosen_columns.append(ChosenColumn(name, _column_field(rule, name, values, declared.get(name)), rule))
    chosen_columns = _place_cells(chosen_columns, path, stream)
    if not declared:
        chosen_columns = _in_one_order(chosen_columns, stream)
    unused = [rule.match for rule in stream.columns if rule not in used]
    are_names = not any(set("{*") & set(match) for match in unused)
    if unused and not (are_names and chosen_columns and lacks_allowed):
        raise TacpipeError(
            f"{path} has no column that matches {listed(unused, 3)} of [streams.{stream.name}]; it has {listed(names, 6)}."
        )
    out = [column.field.name for column in chosen_columns]
    repeated = sorted({name for name in out if out.count(name) > 1})
    if repeated or TIME in out:
        raise TacpipeError(
            f"{path}: [streams.{stream.name}] gives more than one column the name {listed(repeated or [TIME], 3)}; "
            f"each name may be there once, and {TIME} is the time."
        )
    if not chosen_columns:
        raise TacpipeError(f"{path}: [streams.{stream.name}] skips all columns. Name one that is to be read.")
    return chosen_columns, unused


_choose_undeclared = functools.lru_cache(maxsize=16)(_choose_columns)  # a table is read for each recording in it


def _in_one_order(chosen_columns: Sequence[ChosenColumn], stream: StreamLayout) -> list[ChosenColumn]:
    """Return columns in the order of the rules, and those of a rule by its placeholders, numbers by value and w after z.

    Cells of an array stay as they are.
    """
    ranks = {rule: rank for rank, rule in reversed([*enumerate(stream.columns)])}

    def key(column: ChosenColumn) -> tuple[Any, ...]:
        texts = tuple((pattern.match(column.rule.match, column.name) or {}).values()) or (column.name,)
        parts = [part for text in texts for part in natural_order(text.lower())]
        order = tuple((-1, "~") if part == (-1, "w") else part for part in parts)
        return ranks[column.rule], () if column.rule.shape else order

    return sorted(chosen_columns, key=key)


def _place_cells(columns_read: Sequence[ChosenColumn], path: Path, stream: StreamLayout) -> list[ChosenColumn]:
    """Return columns that are cells of an array, with names and metadata for their positions in its shape.

    Raises `TacpipeError` if a rule does not match as many columns as its shape has cells.
    """
    by_rule: dict[ColumnRule, list[ChosenColumn]] = {}
    for column in columns_read:
        by_rule.setdefault(column.rule, []).append(column)
    for rule, cells in by_rule.items():
        if rule.shape and len(cells) != math.prod(rule.shape):
            raise TacpipeError(
                f"{path}: {plain(rule.match)} of [streams.{stream.name}] matches {len(cells)} columns, and shape = "
                f"{list(rule.shape)} has {math.prod(rule.shape)} cells. Correct shape or match."
            )
    cells_before = dict.fromkeys(by_rule, 0)
    placed = []
    for column in columns_read:
        field = _cell_field(column, cells_before[column.rule]) if column.rule.shape else column.field
        cells_before[column.rule] += 1
        placed.append(replace(column, field=field))
    return placed


def _cell_field(column: ChosenColumn, cell: int) -> pa.Field:
    """Return the field of a cell, ``cell`` being its flat index in an array of the shape that the column's rule declares.

    A tactile cell has a taxel and an axis, another cell an index and a component; taxel and index count from 1.
    """
    rule = column.rule
    index = list(np.unravel_index(cell, rule.shape))
    sides = list(rule.shape)
    axis = ""
    if rule.axes:
        axis_position = len(sides) - 1 if sides[-1] == len(rule.axes) else 0
        axis = rule.axes[int(index.pop(axis_position))]
        sides.pop(axis_position)
    number = int(np.ravel_multi_index(index, sides)) + 1 if sides else 1
    count = math.prod(sides)
    is_tactile = rule.quantity in ("", "tactile")
    metadata: dict[str, str] = {}
    plain_name = "taxel" if is_tactile else column.name.rstrip("0123456789").rstrip("_")
    padded = str(number).zfill(max(2, len(str(count))))
    if is_tactile or count > 1:
        metadata["taxel" if is_tactile else "index"] = str(number)
        plain_name += padded
    if axis:
        metadata["axis" if is_tactile else "component"] = axis
        plain_name += f"_{axis}"
    values = pattern.match(rule.match, column.name) or {}
    name = pattern.fill_pattern(rule.name, {**values, "taxel": padded, "axis": axis}) if rule.name else plain_name
    declared_metadata = field_metadata(column.field)
    retained = {key: value for key, value in declared_metadata.items() if key not in values}
    return pa.field(name, column.field.type, metadata={**retained, **metadata, **dict(rule.about)})


def _column_field(rule: ColumnRule, name: str, values: dict[str, str], declared: pa.Field | None) -> pa.Field:
    """Return the field of a column ``name`` that matches a rule with the placeholders ``values``.

    ``declared`` is the field in the file, or None; the rule replaces only the properties that it sets.
    """
    column_name = pattern.fill_pattern(rule.name, values) if rule.name and not rule.shape else name.strip()
    metadata = {"unit": rule.unit, "quantity": rule.quantity, "component": rule.component, **values, **dict(rule.about)}
    metadata = {key: value for key, value in metadata.items() if value}
    if declared is None:
        return pa.field(column_name, TYPES[rule.type or "float64"], metadata=metadata)
    unscaled = declared.type if rule.scale == 1.0 else pa.float64()
    kind = TYPES[rule.type] if rule.type else unscaled
    declared_metadata = field_metadata(declared)
    return pa.field(column_name, kind, metadata={**declared_metadata, **metadata})


def convert_column(
    column: pa.ChunkedArray, target: ChosenColumn, nan_allowed: bool, inf_allowed: bool = False
) -> pa.Array | pa.ChunkedArray:
    """Return a parsed column in its declared type, scaled. Missing values become NaN in floats and empty text.

    Raises `CellError` for values that are missing in other types, infinite or out of range, and for NaN unless
    ``nan_allowed``, because NaN may mean a failed sensor.
    """
    kind = target.field.type
    if column.type == kind and pa.types.is_binary(kind):  # stays chunked, because an array of bytes is limited to 2 GiB
        return column
    if column.type == kind == pa.float64() and target.rule.scale == 1.0 and _is_finite(column):
        return column
    array = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    if pa.types.is_string(kind) or pa.types.is_binary(kind):
        return array.cast(kind).fill_null("" if pa.types.is_string(kind) else b"")
    if not pa.types.is_floating(kind):
        if array.null_count:
            row = int(array.is_null().to_numpy(zero_copy_only=False).argmax())
            raise CellError(row, f'is missing, and {kind} has no value for that. Set type = "float64" for this column')
        try:
            return array.cast(kind)
        except pa.ArrowInvalid:
            row = next(row for row, value in enumerate(array) if not _fits(value, kind))
            raise CellError(row, f"holds {array[row].as_py()}, which is not {kind}") from None
    if pa.types.is_integer(array.type):
        integers = array.fill_null(0).to_numpy(zero_copy_only=False)
        large = (integers > MAX_EXACT) | (integers < -MAX_EXACT)
        if large.any():
            row = int(large.argmax())
            remedy = f'Set type = "{array.type}" for this column'
            raise CellError(row, f"holds {array[row].as_py()}, beyond the whole numbers that a float holds. {remedy}")
    values = array.cast(pa.float64()).to_numpy(zero_copy_only=False)
    missing = array.is_null().to_numpy(zero_copy_only=False)
    bad = (np.isinf(values) & (not inf_allowed)) | (np.isnan(values) & ~missing & (not nan_allowed))
    if bad.any():
        row = int(bad.argmax())
        raise CellError(row, f"holds {values[row]}. Declare it in missing if it is to be read as a missing value")
    scaled = values if target.rule.scale == 1.0 else values * target.rule.scale
    with np.errstate(over="ignore"):
        return pa.array(scaled.astype(kind.to_pandas_dtype()))


def exceeds_floats(column: pa.Array, target: ChosenColumn) -> bool:
    """Return whether a converted column has whole numbers that were rounded, because the layout does not state a type."""
    if target.rule.type is not None or target.rule.scale != 1.0 or not pa.types.is_float64(column.type):
        return False
    chunks = column.chunks if isinstance(column, pa.ChunkedArray) else [column]
    most = 0.0
    for chunk in chunks:
        values = chunk.to_numpy(zero_copy_only=False)
        most = max(most, np.fmax.reduce(values, initial=0.0), -np.fmin.reduce(values, initial=0.0))
    return bool(MAX_EXACT < most < 2.0**64)


def _is_finite(column: pa.ChunkedArray) -> bool:
    """Return whether all floats of a column are finite, which avoids a copy in the common case."""
    chunks = column.chunks if isinstance(column, pa.ChunkedArray) else [column]
    return not column.null_count and all(np.isfinite(chunk.to_numpy()).all() for chunk in chunks)


def _fits(value: pa.Scalar, kind: pa.DataType) -> bool:
    """Return whether a value can be cast to a type."""
    try:
        value.cast(kind)
    except pa.ArrowInvalid:
        return False
    return True
