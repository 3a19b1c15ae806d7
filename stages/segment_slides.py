"""Cut out the slide of each recording.

All slides have the same number of frames, and isolated outliers in tactile readings are replaced by a median.

The slide starts when the static pressure first reaches its trigger, and lasts until the end, regardless of pressure
changes; if the arm was recorded, it lasts while the arm moves. The output has the stream ``slide`` and, with an arm,
``profile``: speed, force and phase over the whole recording. A slide that differs from the protocol is marked
``outside_protocol`` and kept. Recordings of sensors without static pressure stay whole, unless ``trigger`` is load:
then the slide consists of the rows in which the taxels' mean change from rest exceeds its threshold and the arm moves,
according to its positions if there is no other source of its speed. Such a slide is not compared with a protocol.

Example: tacpipe segment slides data/touched -o data/slides
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from tacpipe.channels.streams import COUNT, columns_with_quantity, common_unit, count_axes, finger_stream, remove_spikes
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.plugins.constraints import (
    Fraction,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    StoredAs,
    Unit,
)
from tacpipe.plugins.params import added
from tacpipe.plugins.rows import OUTSIDE, UNNEEDED, RowCounts
from tacpipe.plugins.stage import Attribute, RecordingOutput, stage
from tacpipe.plugins.stream_selection import StreamSelection

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import AnyArray
    from tacpipe.datasets.dataset import Recording
    from tacpipe.io.columns import Columns

# quantities of the streams that the speed and force of an arm are computed from
ARM_QUANTITIES = ("joint_position", "joint_velocity", "position", "velocity", "force")
BLOCK_ROWS = 1 << 14  # rows per block
USUAL_SPEED = 0.75  # quantile of the speed during contact; most of the contact is the slide
_KEPT_WHOLE = (
    "this recording has no static pressure and was kept whole, {} rows. Give --trigger load to cut out the slide where the "
    "sensor is touched and the arm moves."
)


@dataclass(frozen=True)
class Params(StreamSelection):
    """Limits of a slide, the choice of its frames, and the protocol of the recordings.

    The defaults are those of the published BioTac slides: 25 mm/s over 0.2 m (one material 0.15 m), started when the
    finger's pressure reached 40 counts. Half the speed is midway between rest and slide, and the ramp takes 0.1 s. Over
    800 slides the mean pressure of the kept frames is 4 to 133 counts, and the shortest slide lasts 5.95 s.
    """

    # static pressure whose first crossing starts the slide
    pressure_trigger: Annotated[NonNegativeFloat, Unit("count")] = 40.0
    # fraction of speed_m_s above which the arm slides; only if the arm was recorded
    moving_fraction: Annotated[Fraction, StoredAs("moving_share")] = 0.5
    # number of successive rows in which the arm must be that fast, so that isolated outliers are ignored
    steady_frames: PositiveInt = 5
    # frames to keep: middle ones; offset: those from offset_frames after the trigger; none: all
    crop: Literal["middle", "offset", "none"] = "middle"
    frames: PositiveInt = 400  # number of rows to keep; recordings without static pressure are kept whole
    # rows between trigger and first selected frame with crop offset; the authors' files have 101
    offset_frames: NonNegativeInt = 101
    # number of rows around a tactile reading, odd, whose median replaces a spike; 1: never
    spike_frames: PositiveInt = 7
    # scaled median absolute deviations of these rows beyond which a reading is a spike
    spike_deviations: NonNegativeFloat = 5.0
    # minimum height of a spike; contact changes readings by 0 to 235
    spike_count: Annotated[NonNegativeFloat, Unit("count")] = 255.0
    speed_m_s: Annotated[PositiveFloat, Unit("m/s")] = 0.025  # speed of the protocol
    # fraction by which the slide's median speed may differ; published slides differ by up to 0.016
    speed_tolerance: NonNegativeFloat = 0.05
    min_s: Annotated[NonNegativeFloat, Unit("s")] = 5.5  # minimum duration of a slide within the protocol
    # minimum mean pressure within the protocol, below which the finger hardly touches
    pressure_low: Annotated[NonNegativeFloat, Unit("count")] = 2.0
    # maximum mean pressure within the protocol, above which the finger is pressed too hard
    pressure_high: Annotated[NonNegativeFloat, Unit("count")] = 150.0
    # signal that starts and ends the slide: static pressure; load: the taxels' mean change from rest, for any sensor
    trigger: Literal["pressure", "load"] = added("pressure")
    # load at which the slide starts, in the unit of the taxels; by default from their noise at rest
    load_trigger: PositiveFloat | None = added(None)
    # duration whose median is each channel's level without load
    rest_s: Annotated[NonNegativeFloat, Unit("s")] = added(0.2)
    # position of rest_s: start of the recording; lowest: where the channels together are lowest
    rest: Literal["start", "lowest"] = added("start")

    def check(self) -> None:
        """Raise `UsageError` for an even median, for inconsistent pressure limits, and for a load without effect."""
        if self.load_trigger is not None and self.trigger != "load":
            raise UsageError(
                f"load_trigger is {self.load_trigger:g} and trigger is {self.trigger}; give --trigger load with it."
            )
        if self.spike_frames % 2 == 0:
            raise UsageError(
                f"spike_frames is {self.spike_frames}; it must be odd, for a reading has as many rows on both sides."
            )
        if self.pressure_low > self.pressure_high:
            raise UsageError(
                f"pressure_low is {self.pressure_low:g}, above pressure_high, {self.pressure_high:g}; it must be the "
                f"lower one."
            )


@stage(version=1)
def slides(params: Params, recording: Recording) -> RecordingOutput:
    """Return the slide of a recording, with its metrics as attributes."""
    from tacpipe.channels import arm
    from tacpipe.datasets.overview import columns_of, streams_of
    from tacpipe.signals import slides as slide_signals

    if params.trigger == "load":
        return _slide_by_load(params, recording, columns_of(recording))
    streams = streams_of(recording)
    table = finger_stream(recording.name, streams)
    t_ns = table.column("t_ns").to_numpy()  # (time,)
    attributes: dict[str, Attribute]
    table, spikes = remove_spikes(table, params.spike_frames, params.spike_deviations, params.spike_count)
    pressures = columns_with_quantity(table, "static_pressure")
    if not pressures:
        notes = [_KEPT_WHOLE.format(len(t_ns))] if len(t_ns) > params.frames else []
        attributes = {"slide_frames": len(t_ns), "spikes": int(spikes.sum()), "outside_protocol": False}
        return RecordingOutput({"slide": table}, attributes, notes, _count_rows(recording, streams, len(t_ns)))
    pressure = table.column(pressures[0]).to_numpy()
    profile = arm.profile(streams, t_ns)
    try:
        trigger = slide_signals.trigger_row(pressure, params.pressure_trigger)
        slide = (trigger, len(t_ns))
        if profile:
            least_m_s = params.moving_fraction * params.speed_m_s
            slide = slide_signals.sliding_rows(profile["speed_m_s"], trigger, least_m_s, params.steady_frames) or slide
        first, stop = slide_signals.crop_rows(slide, params.frames, params.crop, trigger + params.offset_frames)
    except TacpipeError as error:
        raise TacpipeError(f"Recording {recording.name}: {error}") from error
    protocol = slide_signals.Protocol(
        params.speed_m_s, params.speed_tolerance, params.min_s, params.pressure_low, params.pressure_high
    )
    rows = slice(first, stop)
    statistics = slide_signals.slide_statistics(
        pressure[rows], {name: column[rows] for name, column in profile.items()}
    )
    deviations = slide_signals.protocol_deviations(protocol, int(t_ns[slide[1] - 1] - t_ns[slide[0]]) / 1e9, statistics)
    attributes = {**statistics, "slide_frames": stop - first, "spikes": int(spikes[rows].sum())}
    attributes |= {"outside_protocol": bool(deviations)} | (
        {"outside_protocol_why": "; ".join(deviations)} if deviations else {}
    )
    tables = {"slide": table.slice(first, stop - first).combine_chunks()}
    if profile:
        tables["profile"] = arm.profile_table(t_ns, pressure, profile, slide_signals.phases(len(t_ns), slide))
    used = len(t_ns) if profile else stop - first  # the profile has the pressure of every row
    return RecordingOutput(tables, attributes, rows=_count_rows(recording, streams, used, has_arm=bool(profile)))


def _count_rows(
    recording: Recording, streams: Mapping[str, pa.Table | Columns], used: int, *, has_arm: bool = False
) -> dict[str, RowCounts]:
    """Return the rows of each stream, of which ``used`` ones of the finger; those of an arm within the finger's time."""
    finger = finger_stream(recording.name, streams)
    counts_of_finger = RowCounts.some_used(finger.num_rows, used, "outside the slide")
    if recording.streams == ("",):
        return {"": counts_of_finger}
    begin_ns, end_ns = finger.column("t_ns").to_numpy()[[0, -1]]
    rows: dict[str, RowCounts] = {}
    for name, table in streams.items():
        t_ns = table.column("t_ns").to_numpy()
        is_arm = has_arm and any(columns_with_quantity(table, quantity) for quantity in ARM_QUANTITIES)
        inside = int(((t_ns >= begin_ns) & (t_ns <= end_ns)).sum()) if is_arm else 0
        arm_counts = RowCounts.some_used(len(t_ns), inside, OUTSIDE if is_arm else UNNEEDED)
        rows[name] = counts_of_finger if table is finger else arm_counts
    return rows


def _slide_by_load(params: Params, recording: Recording, streams: Mapping[str, pa.Table | Columns]) -> RecordingOutput:
    """Return the slide of a sensor with any unit: the rows in contact in which the arm moves, if it was recorded.

    Raises `TacpipeError` if there is no tactile stream or no slide.
    """
    import numpy as np
    import pyarrow as pa

    from tacpipe.channels import arm
    from tacpipe.io.columns import release
    from tacpipe.signals import slides as slide_signals
    from tacpipe.signals.contact import OFF_FRACTION, Thresholds, load_in_blocks, measure_rest, noise_thresholds

    name, stream = recording.name, finger_stream(recording.name, streams)
    t_ns, names = stream.column("t_ns").to_numpy(), columns_with_quantity(stream, "tactile")
    measured = np.ones(len(names), bool)  # (channel,), whether a channel has a value in each row

    def blocks() -> Iterator[AnyArray]:
        nonlocal measured
        for some in _batches(stream, names):
            values = np.column_stack([column.to_numpy() for column in some.columns])  # (time, channel)
            measured &= ~np.isnan(values).any(axis=0)
            yield values

    level, rows = measure_rest(params.rest, blocks, t_ns, params.rest_s)
    loads, repeated = load_in_blocks(blocks, level, count_axes(stream.schema, names))
    if params.load_trigger is None:
        limits = noise_thresholds(repeated, loads, rows)
    else:
        limits = Thresholds(params.load_trigger, OFF_FRACTION * params.load_trigger)
    unit = common_unit(stream.schema, names)
    release()  # frees the memory of the channels
    profile = arm.profile(streams, t_ns, by_place=True)
    release()
    try:
        touched = slide_signals.loaded_rows(loads, limits.on, limits.off, unit)
        slide = touched
        if profile:
            usual_m_s = float(np.nanquantile(profile["speed_m_s"][slice(*touched)], USUAL_SPEED))
            moving = slide_signals.sliding_rows(
                profile["speed_m_s"][: touched[1]], touched[0], params.moving_fraction * usual_m_s, params.steady_frames
            )
            slide = moving or touched
        first, stop = slide_signals.crop_rows(slide, params.frames, params.crop, touched[0] + params.offset_frames)
    except TacpipeError as error:
        raise TacpipeError(f"Recording {name}: {error}") from error
    kept_rows = slice(first, stop)
    height = params.spike_count if unit == COUNT else limits.on
    # range of rows over which the medians are computed
    begin, end = max(0, first - params.spike_frames), stop + params.spike_frames
    pieces, count = [], 0
    for some in _batches(stream, stream.schema.names):
        pieces.append(some.slice(max(0, begin - count), max(0, end - max(begin, count))))
        count += some.num_rows
        if count >= end:
            break
    whole = [channel for channel, is_measured in zip(names, measured, strict=True) if is_measured]
    table, spikes = remove_spikes(pa.concat_tables(pieces), params.spike_frames, params.spike_deviations, height, whole)
    attributes: dict[str, Attribute] = {
        "load_mean": float(f"{loads[kept_rows].mean():.4g}"),
        "load_trigger": float(f"{limits.on:.4g}"),
        "slide_frames": stop - first,
        "spikes": int(spikes[first - begin : stop - begin].sum()),
        "outside_protocol": False,
    }
    if profile and np.isfinite(profile["speed_m_s"][kept_rows]).all():
        attributes["speed_m_s"] = round(float(np.median(profile["speed_m_s"][kept_rows])), 5)
    rows_by_stream = _count_rows(recording, streams, stop - first, has_arm=bool(profile))
    slide_table = table.slice(first - begin, stop - first).combine_chunks()
    return RecordingOutput({"slide": slide_table}, attributes, rows=rows_by_stream)


def _batches(stream: pa.Table | Columns, names: Sequence[str]) -> Iterator[pa.Table]:
    """Yield columns of a stream in batches of rows."""
    import pyarrow as pa

    if not isinstance(stream, pa.Table):
        yield from stream.batches(names)
        return
    table = stream.select(list(names))
    yield from (table.slice(first, BLOCK_ROWS) for first in range(0, table.num_rows, BLOCK_ROWS))
