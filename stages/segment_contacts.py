"""Mark contacts in synchronized recordings.

Rows in contact with any finger are numbered by contact from 0 in the column ``contact``; all others have -1. The field
metadata ``rest`` of each tactile channel has its level without load. Contact is detected from the median of the first
seconds (``rest``), regardless of ``tare``. A stream in counts uses the thresholds ``on_count`` and ``off_count``,
unless ``thresholds`` is noise. A stream in any other unit uses ``on_level`` and ``off_level``, or thresholds from its
noise at rest. The attributes ``<stream>_contact_on``, ``<stream>_contact_off`` and ``<stream>_contact_unit`` state
them. A note lists recordings without contact.

Example: tacpipe segment contacts data/synced -o data/segments
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from tacpipe.channels.schema import is_truth
from tacpipe.channels.streams import AT_ARRIVAL, COUNT, common_unit, count_axes, missing_channel_error
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.plugins.constraints import NonNegativeFloat, PositiveFloat, Unit
from tacpipe.plugins.params import added
from tacpipe.plugins.stage import Attribute, RecordingOutput, stage
from tacpipe.plugins.stream_selection import StreamSelection

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import AnyArray, Bools, Floats
    from tacpipe.datasets.dataset import Recording
    from tacpipe.io.columns import Columns
    from tacpipe.signals.contact import Thresholds


@dataclass(frozen=True)
class Params(StreamSelection):
    """Criteria for contact and for the level without load.

    Thresholds in counts are for streams in counts, and are based on 52 published pick-and-move trials of a XELA uSkin:
    at rest the load stays below 6 counts, in the grasp above 240 and mostly above 1000, and after a drop up to 65
    counts remain for seconds. Thresholds of streams in any other unit are computed from the noise at rest unless
    specified.
    """

    # free: the recording starts without contact; grasped: all of the recording is one contact
    begins: Literal["free", "grasped"] = "free"
    # duration at the start whose median is each channel's level without load
    rest_s: Annotated[NonNegativeFloat, Unit("s")] = 0.2
    # mean change of a finger's taxels from rest at which contact starts
    on_count: Annotated[PositiveFloat, Unit("count")] = 120.0
    off_count: Annotated[NonNegativeFloat, Unit("count")] = 80.0  # mean change below which contact ends
    merge_s: Annotated[NonNegativeFloat, Unit("s")] = 0.5  # maximum gap between two contacts that are merged
    min_s: Annotated[NonNegativeFloat, Unit("s")] = 0.3  # minimum duration of a contact
    pad_s: Annotated[NonNegativeFloat, Unit("s")] = 0.5  # duration before and after a contact that is added to it
    # level at which contact starts, for streams in other units; by default from the noise at rest
    on_level: PositiveFloat | None = added(None)
    # level below which contact ends, for streams in other units; by default two thirds of on_level
    off_level: NonNegativeFloat | None = added(None)
    # level in `rest`: median of rest_s; first row; axis_mean: all taxels start at their axis' mean
    tare: Literal["median", "first", "axis_mean"] = "median"
    # thresholds of streams in counts: unit, on_count and off_count; noise, computed from noise at rest as in other
    # units
    thresholds: Literal["unit", "noise"] = added("unit")
    # position of rest_s: start (of the recording), or lowest (where the channels together are lowest)
    rest: Literal["start", "lowest"] = added("start")

    def check(self) -> None:
        """Raise `UsageError` for contacts that end above their start level, and for thresholds without effect."""
        if self.thresholds == "noise" and (self.on_count, self.off_count) != (Params.on_count, Params.off_count):
            raise UsageError(
                f"thresholds is noise, and on_count {self.on_count:g} and off_count {self.off_count:g} would do nothing; "
                f"give --on-level and --off-level, or leave --thresholds out."
            )
        if self.off_count > self.on_count:
            raise UsageError(
                f"off_count is {self.off_count:g}, above on_count, {self.on_count:g}; a contact must end at or below the "
                f"load at which it begins."
            )


@stage(version=2)
def contacts(params: Params, recording: Recording) -> RecordingOutput:
    """Return the recording with each row's contact number."""
    import numpy as np
    import pyarrow as pa

    from tacpipe.arrays import from_arrow, to_arrow
    from tacpipe.io.columns import change
    from tacpipe.io.parquet import with_metadata
    from tacpipe.signals.contact import (
        Thresholds,
        contact_intervals,
        load_in_blocks,
        measure_rest,
        noise_thresholds,
        tare_level,
    )

    columns = recording.columns()
    t_ns = from_arrow(columns.column("t_ns"))  # (time,)
    is_timed = _timed_rows(recording.name, columns)
    columns.forget()
    loads: list[Floats] = []
    thresholds: list[Thresholds] = []
    rest_metadata: dict[str, dict[str, str]] = {}
    schema = columns.schema
    sensors = _tactile_columns(recording.name, schema)
    units = {stream: common_unit(schema, names) for stream, names in sensors.items()}
    fixed_streams = {stream for stream, unit in units.items() if unit == COUNT and params.thresholds == "unit"}
    _check_levels(params, recording.name, units, fixed_streams)
    for stream, names in sensors.items():

        def blocks(names: Sequence[str] = names) -> Iterator[AnyArray]:
            for table in columns.batches(names):
                yield np.column_stack([from_arrow(table.column(name)) for name in names])  # (time, channel)

        def timed_blocks(blocks: Callable[[], Iterator[AnyArray]] = blocks) -> Iterator[AnyArray]:
            first = 0
            for values in blocks():
                rows = is_timed[first : first + len(values)]
                first += len(values)
                if rows.any():
                    yield values if rows.all() else values[rows]

        axes = count_axes(schema, names)
        level, at_rest = measure_rest(params.rest, timed_blocks, t_ns[is_timed], params.rest_s)
        rest_rows = np.zeros(len(t_ns), bool)
        rest_rows[is_timed] = at_rest
        load, repeated = load_in_blocks(blocks, level, axes)
        loads.append(load)
        if stream in fixed_streams:
            thresholds.append(Thresholds(params.on_count, params.off_count))
        else:
            thresholds.append(_fixed_thresholds(params, noise_thresholds(repeated, load, rest_rows)))
        tare_values = tare_level(params.tare, next(timed_blocks()), level, axes)
        rest_metadata |= {name: {"rest": repr(float(value))} for name, value in zip(names, tare_values, strict=True)}
    all_loads = np.array(loads)  # (sensor, time)
    loads.clear()
    if params.begins == "grasped":
        intervals = np.array([[0, len(t_ns)]])
    else:
        on, off = np.array(thresholds).T
        intervals = contact_intervals(all_loads, t_ns, on, off, params.min_s, params.merge_s, params.pad_s)
    contact_numbers = np.full(len(t_ns), -1, dtype=np.int32)
    for number, (start, stop) in enumerate(intervals):
        contact_numbers[start:stop] = number
    field = pa.field("contact", pa.int32(), metadata={"unit": "1", "quantity": "label"})
    max_loads = [float(np.nanmax(load, initial=0.0)) for load in all_loads]
    notes = [] if len(intervals) else [_no_contact_note(params, units, thresholds, max_loads, fixed_streams)]

    def add_contact(table: pa.Table, first: int) -> pa.Table:
        contact = to_arrow(contact_numbers[first : first + table.num_rows])
        return with_metadata(table.append_column(field, contact), rest_metadata)

    return RecordingOutput(change(columns, add_contact), _threshold_attributes(units, thresholds, fixed_streams), notes)


def _timed_rows(name: str, columns: Columns) -> Bools:
    """Return a mask of the rows (time,) whose sampling time is known; others do not determine the level at rest.

    Raises `TacpipeError` without such rows.
    """
    import numpy as np

    from tacpipe.arrays import from_arrow

    if AT_ARRIVAL not in columns.column_names:
        return np.ones(columns.num_rows, bool)
    is_timed: Bools = ~from_arrow(columns.column(AT_ARRIVAL))
    if not is_timed.any():
        raise TacpipeError(
            f"Recording {name} has no row whose sampling time is known, because its master does not measure at a constant "
            "rate. Synchronize it with --rate-hz."
        )
    return is_timed


def _check_levels(params: Params, name: str, units: Mapping[str, str], fixed: Collection[str]) -> None:
    """Raise `UsageError` for thresholds in a unit that no stream has, because they would have no effect.

    ``fixed`` are the streams with thresholds in counts.
    """
    if params.on_level is not None and params.on_level <= 0:
        raise UsageError(f"on_level is {params.on_level:g}; it must be above 0, or every row would be in contact.")
    described = ", ".join(f"{stream or 'a sensor'} in {unit or 'no unit'}" for stream, unit in units.items())
    if set(fixed) == set(units) and (params.on_level, params.off_level) != (None, None):
        raise UsageError(
            f"on_level and off_level are of streams in other units than counts, and recording {name} has {described}; give "
            f"on_count and off_count, or --thresholds noise."
        )
    if COUNT not in units.values() and (params.on_count, params.off_count) != (Params.on_count, Params.off_count):
        raise UsageError(
            f"on_count and off_count are of streams in counts, and recording {name} has {described}; give on_level and "
            f"off_level in that unit, or none: then they follow from the noise at rest."
        )


def _fixed_thresholds(params: Params, thresholds: Thresholds) -> Thresholds:
    """Return the thresholds of a stream that is not in counts: those in the params, or otherwise ``thresholds``."""
    from tacpipe.signals.contact import OFF_FRACTION

    on = thresholds.on if params.on_level is None else params.on_level
    return thresholds._replace(on=on, off=OFF_FRACTION * on if params.off_level is None else params.off_level)


def _threshold_attributes(
    units: Mapping[str, str], limits: Sequence[Thresholds], fixed: Collection[str]
) -> dict[str, Attribute]:
    """Return attributes with the thresholds of streams that are not in ``fixed``, and their unit."""
    attributes: dict[str, Attribute] = {}
    for (stream, unit), (on, off) in zip(units.items(), limits, strict=True):
        if stream not in fixed and math.isfinite(on):
            prefix = f"{stream}_contact" if stream else "contact"
            attributes |= {f"{prefix}_on": on, f"{prefix}_off": off, f"{prefix}_unit": unit}
    return attributes


def _no_contact_note(
    params: Params,
    units: Mapping[str, str],
    limits: Sequence[Thresholds],
    largest: Sequence[float],
    fixed: Collection[str],
) -> str:
    """Return the note for a recording without contact: thresholds, maximum load, and what to do."""
    descriptions = []
    for (stream, unit), (on, _), largest_load in zip(units.items(), limits, largest, strict=True):
        subject = stream or "the sensor"
        if math.isfinite(on):
            threshold = f"{subject} starts contact at a load of {_number(on)} {unit}".rstrip()
            descriptions.append(f"{threshold} and reaches {_number(largest_load)} {unit}".rstrip())
        else:
            descriptions.append(f"{subject} never leaves its level at rest")
    names = ["--on-count"] * bool(fixed) + ["--on-level"] * (set(fixed) != set(units))
    alternative = ", or give --thresholds noise" if fixed else ""
    # a contact within rest_s becomes the level at rest, and its change the noise
    touched_first = f" If it was touched in the first {params.rest_s:g} s, give --rest lowest." * (
        params.rest == "start"
    )
    return (
        f"no contact of {params.min_s:g} s or more was found in this recording: {'; '.join(descriptions)}. If something was "
        f"touched, lower {' and '.join(names)}{alternative}.{touched_first}"
    )


def _number(value: float) -> str:
    """Format a number with three significant digits, if possible without an exponent."""
    return f"{float(f'{value:.3g}'):g}"


def _tactile_columns(name: str, schema: pa.Schema) -> dict[str, list[str]]:
    """Return the tactile columns of each stream, grouped by taxel. Raises `TacpipeError` if there are none."""
    columns_by_stream: dict[str, list[str]] = {}
    for field in schema:
        metadata = field.metadata or {}
        if metadata.get(b"quantity") == b"tactile" and not is_truth(field):
            columns_by_stream.setdefault(metadata.get(b"stream", b"").decode(), []).append(field.name)
    if not columns_by_stream:
        raise missing_channel_error(name, "tactile", schema)
    return columns_by_stream
