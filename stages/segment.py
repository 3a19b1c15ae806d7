"""Mark contacts and slips in recordings, or cut out slides.

Segments choose what a model is trained on. Contacts and slips throw nothing away, all rows stay; of a slide the frames
remain that are alike in all recordings.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Literal

from tacpipe.channels.absent import absent, entry
from tacpipe.channels.pose import METRES
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
from tacpipe.plugins.stage import Attribute, RecordingOutput, stage

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import AnyArray, Bools, Floats, Times
    from tacpipe.datasets.dataset import Recording
    from tacpipe.signals.contact import Thresholds

COUNT = "count"
USUAL_SPEED = 0.75  # quantile of the speed in contact: that of the slide, which is most of it
_KEPT_WHOLE = (
    "this recording has no static pressure and was kept whole, {} rows. Give --trigger load to cut out the slide where the "
    "sensor is touched and the arm moves."
)
EVEN = 0.01  # of a step between rows, by which it may differ from the others for a filter of even steps


@dataclass(frozen=True)
class Params:
    """What counts as contact, and as the level without load.

    Thresholds in counts are for streams in counts, and stem from 52 published pick-and-move trials of a XELA uSkin: at
    rest the load stays below 6 counts, in the grasp above 240 and mostly above 1000, and after a drop up to 65 counts
    remain for seconds. Those of streams in any other unit follow from the noise at rest, unless they are given.
    """

    # free: nothing is touched at first; grasped: all of the recording is one contact
    begins: Literal["free", "grasped"] = "free"
    # time at the start whose median is each channel's level without load
    rest_s: Annotated[NonNegativeFloat, Unit("s")] = 0.2
    # mean change of a finger's taxels from rest at which contact starts
    on_count: Annotated[PositiveFloat, Unit("count")] = 120.0
    off_count: Annotated[NonNegativeFloat, Unit("count")] = 80.0  # mean change below which it ends
    merge_s: Annotated[NonNegativeFloat, Unit("s")] = 0.5  # largest gap between two contacts that are merged
    min_s: Annotated[NonNegativeFloat, Unit("s")] = 0.3  # shortest contact that is kept
    pad_s: Annotated[NonNegativeFloat, Unit("s")] = 0.5  # time before and after each contact that belongs to it
    # as on_count, of streams in other units, in theirs; None: from noise at rest
    on_level: PositiveFloat | None = added(None)
    # level below which it ends there; None: two thirds of where it starts
    off_level: NonNegativeFloat | None = added(None)
    # what `rest` is: median of rest_s; first row; axis_mean: taxels begin at their axis' mean
    tare: Literal["median", "first", "axis_mean"] = "median"
    # of streams in counts: unit, on_count and off_count; noise, from their noise at rest as those in other units
    thresholds: Literal["unit", "noise"] = added("unit")
    # which rest_s: start of the recording; lowest: those in which the channels are lowest together
    rest: Literal["start", "lowest"] = added("start")

    def check(self) -> None:
        """Refuse contacts that end above where they begin, and thresholds in counts that would do nothing."""
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
    """Mark contacts in synchronized recordings.

    Rows in which either finger is in contact are numbered from 0 in the column ``contact``; all others have -1. Each
    tactile channel's level without load is written into its field metadata ``rest``. Contact is detected from the
    median of the first seconds (``rest``), whatever ``tare`` is. A stream in counts has the thresholds of ``on_count``
    and ``off_count``, unless ``thresholds`` is noise. One in any other unit has those of ``on_level`` and ``off_level``
    or of its noise at rest (see `tacpipe.signals.contact.noise_thresholds`), and the attributes
    ``<stream>_contact_on``, ``<stream>_contact_off`` and ``<stream>_contact_unit`` record them. A recording without a
    contact has a note.

    Example: tacpipe segment contacts data/synced -o data/segments
    """
    import numpy as np
    import pyarrow as pa

    from tacpipe.io.parquet import with_metadata
    from tacpipe.signals.contact import Thresholds, contact_intervals, load, noise_thresholds

    table = recording.table()
    t_ns = table.column("t_ns").to_numpy()  # (time,)
    loads: list[Floats] = []
    limits: list[Thresholds] = []
    rest: dict[str, dict[str, str]] = {}
    sensors = _sensors(recording.name, table)
    units = {stream: _unit(table, names) for stream, names in sensors.items()}
    fixed = {stream for stream, unit in units.items() if unit == COUNT and params.thresholds == "unit"}
    _check_levels(params, recording.name, units, fixed)
    for stream, names in sensors.items():
        values = np.column_stack([table.column(name).to_numpy() for name in names])  # (time, channel)
        axes = len({(table.field(name).metadata or {}).get(b"axis") for name in names})
        level, rows = _rest(params.rest, values, t_ns, params.rest_s)
        loads.append(load(values, level, axes))
        if stream in fixed:
            limits.append(Thresholds(params.on_count, params.off_count))
        else:
            limits.append(_given(params, noise_thresholds(values, loads[-1], t_ns, params.rest_s, rows)))
        written = _tared(params.tare, values, level, axes)
        rest |= {name: {"rest": repr(float(value))} for name, value in zip(names, written, strict=True)}
    if params.begins == "grasped":
        intervals = np.array([[0, len(t_ns)]])
    else:
        on, off = np.array(limits).T
        intervals = contact_intervals(np.array(loads), t_ns, on, off, params.min_s, params.merge_s, params.pad_s)
    numbers = np.full(len(t_ns), -1, dtype=np.int32)
    for number, (start, stop) in enumerate(intervals):
        numbers[start:stop] = number
    field = pa.field("contact", pa.int32(), metadata={"unit": "1", "quantity": "label"})
    largest = [float(np.nanmax(one, initial=0.0)) for one in loads]
    notes = [] if len(intervals) else [_no_contact(params, units, limits, largest, fixed)]
    marked = with_metadata(table.append_column(field, pa.array(numbers)), rest)
    return RecordingOutput(marked, _threshold_attributes(units, limits, fixed), notes)


@dataclass(frozen=True)
class SlipParams:
    """What counts as slip and as drop, in the readings of a proximity sensor that looks at the held object.

    Thresholds are in multiples of the noise of the readings' rate after the grasp. Readings in a unit of length are
    taken as so many counts as ``count_per_mm`` makes of them, and never saturate. One millimetre is 8 counts on the
    published rig, its fingers' patch 25 mm, its noise 0.8 counts and its smallest reading 544.
    """

    channel: str = ""  # column with the readings; empty for the only one whose quantity is proximity
    # cut-off of the low-pass filter applied before the rate is computed
    cutoff_hz: Annotated[PositiveFloat, Unit("Hz")] = 5.0
    # time after the grasp without slip, from which noise and level are estimated
    still_s: Annotated[PositiveFloat, Unit("s")] = 0.5
    on_sigma: PositiveFloat = 5.0  # times the rate's noise, beyond which slip begins
    off_sigma: PositiveFloat = 2.0  # times the rate's noise, below which it ends
    on_frames: PositiveInt = 3  # rows that it must be beyond
    off_frames: PositiveInt = 5  # rows that it must be below
    # least noise of the rate: a reading's step of one count makes 10 of them
    noise_floor: Annotated[PositiveFloat, Unit("count/s")] = 3.0
    # largest change of readings that counts as no change of level
    level_count: Annotated[PositiveFloat, Unit("count")] = 0.75
    patch_mm: Annotated[PositiveFloat, Unit("mm")] = 25.0  # slipped distance from which an object is lost
    count_per_mm: Annotated[PositiveFloat, Unit("count/mm")] = 8.0  # sensitivity of the sensor
    # largest reading of a lost object: nothing is within the sensor's range
    saturated_count: Annotated[NonNegativeFloat, Unit("count")] = 544.0

    def check(self) -> None:
        """Refuse slips that end above where they begin."""
        if self.off_sigma > self.on_sigma:
            raise UsageError(
                f"off_sigma is {self.off_sigma:g}, above on_sigma, {self.on_sigma:g}; a slip must end at or below the rate "
                f"at which it begins."
            )


@stage(version=2)
def slips(params: SlipParams, recording: Recording) -> pa.Table:
    """Mark slips and drops of a held object.

    They are detected by the object's distance from the wrist. Adds the labels ``slip``, detected in the whole
    recording, ``slip_online``, detected from the rows so far, and ``dropped``. Run it behind ``segment contacts``: each
    contact is a grasp, and a drop lasts until the next one. Without the column ``contact`` all of the recording is one.
    Outside of contacts, after a drop and where there is no reading nothing slips.

    Example: tacpipe segment slips data/segments -o data/slips
    """
    import numpy as np
    import pyarrow as pa

    from tacpipe.signals import slip

    table = recording.table()
    if "slip" in table.column_names:
        raise TacpipeError(f"Recording {recording.name} has a column slip already; give what was there before it.")
    channel = _proximity(recording.name, params.channel, table)
    readings, saturated = table.column(channel).to_numpy().astype(np.float64), params.saturated_count
    unit = (table.field(channel).metadata or {}).get(b"unit", b"").decode()
    if unit in METRES:
        readings, saturated = readings * (1e3 * METRES[unit] * params.count_per_mm), -math.inf
    elif unit not in (COUNT, ""):
        raise _no_distance(recording.name, channel, unit, table)
    t_ns = table.column("t_ns").to_numpy()
    rate_hz = _rate_hz(recording.name, t_ns)
    contact = table.column("contact").to_numpy() if "contact" in table.column_names else np.zeros(len(t_ns))
    still, patch_count = round(params.still_s * rate_hz), params.patch_mm * params.count_per_mm
    limits = slip.Limits(
        on_sigma=params.on_sigma,
        off_sigma=params.off_sigma,
        on_rows=params.on_frames,
        off_rows=params.off_frames,
        noise_floor=params.noise_floor,
        level_count=params.level_count,
    )
    values = slip.filled(readings)
    labels = {name: np.zeros(len(t_ns), dtype=bool) for name in ("slip", "slip_online", "dropped")}
    grasps = np.flatnonzero((contact >= 0) & (np.diff(contact, prepend=-1) != 0)).tolist()
    for rows in (slice(*ends) for ends in pairwise([*grasps, len(t_ns)])):  # each grasp has its own level and noise
        since, held = values[rows], (contact[rows] >= 0) & np.isfinite(readings[rows])
        lost = slip.dropped(since, still, patch_count, saturated)
        known_lost = slip.dropped_online(since, still, patch_count, saturated)
        labels["dropped"][rows] = lost
        labels["slip"][rows] = held & ~lost & slip.slip_offline(since, rate_hz, params.cutoff_hz, still, limits)
        known = slip.slip_online(since, rate_hz, params.cutoff_hz, still, limits)
        labels["slip_online"][rows] = held & ~known_lost & known
    for name, marks in labels.items():
        field = pa.field(name, pa.int8(), metadata={"unit": "1", "quantity": "label"})
        table = table.append_column(field, pa.array(marks.astype(np.int8)))
    return table


@dataclass(frozen=True)
class SlideParams:
    """Where a slide begins and ends, which of its frames are kept, and what the protocol of the recordings was.

    The defaults are those of the published BioTac slides: 25 mm/s over 0.2 m (one material 0.15 m), begun when the
    finger's pressure reached 40 counts. Half the speed lies in the middle between rest and slide, whose ramp takes 0.1
    s. Over 800 slides the mean pressure of the kept frames is 4 to 133 counts, and the shortest lasts 5.95 s.
    """

    # static pressure whose first crossing starts the slide
    pressure_trigger: Annotated[NonNegativeFloat, Unit("count")] = 40.0
    # fraction of speed_m_s above which the arm slides; only where the arm was recorded
    moving_fraction: Annotated[Fraction, StoredAs("moving_share")] = 0.5
    steady_frames: PositiveInt = 5  # rows that the arm must move so fast, or a single wrong reading would count
    # which frames: of the middle; offset: from offset_frames behind the trigger on; none: all
    crop: Literal["middle", "offset", "none"] = "middle"
    frames: PositiveInt = 400  # rows that are kept; recordings without static pressure are kept whole
    # rows between trigger and kept frames with crop offset; the authors' files have 101
    offset_frames: NonNegativeInt = 101
    # rows around a tactile reading, odd, whose median replaces it if it is a spike; 1: never
    spike_frames: PositiveInt = 7
    # scaled median absolute deviations of these rows, beyond which it is a spike
    spike_deviations: NonNegativeFloat = 5.0
    # least height of a spike; contact changes readings by 0 to 235
    spike_count: Annotated[NonNegativeFloat, Unit("count")] = 255.0
    speed_m_s: Annotated[PositiveFloat, Unit("m/s")] = 0.025  # speed of the protocol
    # fraction by which the slide's median speed may differ; published ones do by 0.016
    speed_tolerance: NonNegativeFloat = 0.05
    min_s: Annotated[NonNegativeFloat, Unit("s")] = 5.5  # shortest slide within the protocol
    # least mean pressure within the protocol; below, the finger hardly touched
    pressure_low: Annotated[NonNegativeFloat, Unit("count")] = 2.0
    # largest mean pressure within the protocol; above, the finger was pressed too hard
    pressure_high: Annotated[NonNegativeFloat, Unit("count")] = 150.0
    # what the slide begins and ends by: pressure, the static one; load, the taxels' mean change from rest, of any sensor
    trigger: Literal["pressure", "load"] = added("pressure")
    # load at which the slide begins, in the unit of the taxels; None: from their noise at rest
    load_trigger: PositiveFloat | None = added(None)
    # time whose median is each channel's level without load
    rest_s: Annotated[NonNegativeFloat, Unit("s")] = added(0.2)
    # which rest_s: start of the recording; lowest: those in which the channels are lowest together
    rest: Literal["start", "lowest"] = added("start")

    def check(self) -> None:
        """Refuse an even median, bounds of the pressure with nothing between them, and a load that would do nothing."""
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
def slides(params: SlideParams, recording: Recording) -> RecordingOutput:
    """Cut out the slide of each recording.

    All slides have the same number of frames, and single wrong tactile readings are replaced by a median.

    The slide starts where the static pressure first reaches its trigger, and lasts to the end, however the pressure
    changes; where the arm was recorded, it lasts while the arm moves. Returns the stream ``slide``, and with an arm
    ``profile``, its speed, force and phase over the whole recording. A slide that differs from the protocol is marked
    ``outside_protocol`` and kept. Recordings of sensors without static pressure stay whole, unless ``trigger`` is load:
    then the slide is where the taxels' mean change from rest exceeds its threshold, and where the arm moves, by its
    positions if nothing else gives its speed. Of such a slide no protocol is known, and none is checked.

    Example: tacpipe segment slides data/touched -o data/slides
    """
    from tacpipe.channels import arm
    from tacpipe.channels.finger import finger, without_spikes
    from tacpipe.channels.streams import of_quantity
    from tacpipe.datasets.streams import streams_of
    from tacpipe.signals import slides as found

    streams = streams_of(recording)
    table = finger(recording.name, streams)
    t_ns = table.column("t_ns").to_numpy()  # (time,)
    if params.trigger == "load":
        return _slide_by_load(params, recording.name, streams, table)
    attributes: dict[str, Attribute]
    table, spikes = without_spikes(table, params.spike_frames, params.spike_deviations, params.spike_count)
    pressures = of_quantity(table, "static_pressure")
    if not pressures:
        notes = [_KEPT_WHOLE.format(len(t_ns))] if len(t_ns) > params.frames else []
        attributes = {"slide_frames": len(t_ns), "spikes": int(spikes.sum()), "outside_protocol": False}
        return RecordingOutput({"slide": table}, attributes, notes)
    pressure = table.column(pressures[0]).to_numpy()
    profile = arm.profile(streams, t_ns)
    try:
        trigger = found.trigger_row(pressure, params.pressure_trigger)
        slide = (trigger, len(t_ns))
        if profile:
            least_m_s = params.moving_fraction * params.speed_m_s
            slide = found.sliding_rows(profile["speed_m_s"], trigger, least_m_s, params.steady_frames) or slide
        first, stop = found.kept_rows(slide, params.frames, params.crop, trigger + params.offset_frames)
    except TacpipeError as error:
        raise TacpipeError(f"Recording {recording.name}: {error}") from error
    protocol = found.Protocol(
        params.speed_m_s, params.speed_tolerance, params.min_s, params.pressure_low, params.pressure_high
    )
    rows = slice(first, stop)
    described = found.measured(pressure[rows], {name: column[rows] for name, column in profile.items()})
    why = found.departures(protocol, int(t_ns[slide[1] - 1] - t_ns[slide[0]]) / 1e9, described)
    attributes = {**described, "slide_frames": stop - first, "spikes": int(spikes[rows].sum())}
    attributes |= {"outside_protocol": bool(why)} | ({"outside_protocol_why": "; ".join(why)} if why else {})
    tables = {"slide": table.slice(first, stop - first).combine_chunks()}
    if profile:
        tables["profile"] = arm.profile_table(t_ns, pressure, profile, found.phases(len(t_ns), slide))
    return RecordingOutput(tables, attributes)


def _slide_by_load(params: SlideParams, name: str, streams: Mapping[str, pa.Table], table: pa.Table) -> RecordingOutput:
    """Return the slide of a sensor of any unit: the rows in contact, and of these those in which the arm moves."""
    import numpy as np

    from tacpipe.channels import arm
    from tacpipe.channels.finger import without_spikes
    from tacpipe.channels.streams import of_quantity
    from tacpipe.signals import slides as found
    from tacpipe.signals.contact import ENDS, Thresholds, load, noise_thresholds

    t_ns, names = table.column("t_ns").to_numpy(), of_quantity(table, "tactile")
    values = np.column_stack([table.column(one).to_numpy() for one in names])  # (time, channel)
    axes = len({(table.field(one).metadata or {}).get(b"axis") for one in names})
    level, rows = _rest(params.rest, values, t_ns, params.rest_s)
    loaded = load(values, level, axes)
    if params.load_trigger is None:
        limits = noise_thresholds(values, loaded, t_ns, params.rest_s, rows)
    else:
        limits = Thresholds(params.load_trigger, ENDS * params.load_trigger)
    unit = _unit(table, names)
    profile = arm.profile(streams, t_ns, by_place=True)
    try:
        touched = found.touched_rows(loaded, limits.on, limits.off, unit)
        slide = touched
        if profile:
            usual_m_s = float(np.nanquantile(profile["speed_m_s"][slice(*touched)], USUAL_SPEED))
            moving = found.sliding_rows(
                profile["speed_m_s"][: touched[1]], touched[0], params.moving_fraction * usual_m_s, params.steady_frames
            )
            slide = moving or touched
        first, stop = found.kept_rows(slide, params.frames, params.crop, touched[0] + params.offset_frames)
    except TacpipeError as error:
        raise TacpipeError(f"Recording {name}: {error}") from error
    kept = slice(first, stop)
    height = params.spike_count if unit == COUNT else limits.on
    table, spikes = without_spikes(table, params.spike_frames, params.spike_deviations, height)
    attributes: dict[str, Attribute] = {
        "load_mean": float(f"{loaded[kept].mean():.4g}"),
        "load_trigger": float(f"{limits.on:.4g}"),
        "slide_frames": stop - first,
        "spikes": int(spikes[kept].sum()),
        "outside_protocol": False,
    }
    if profile and np.isfinite(profile["speed_m_s"][kept]).all():
        attributes["speed_m_s"] = round(float(np.median(profile["speed_m_s"][kept])), 5)
    return RecordingOutput({"slide": table.slice(first, stop - first).combine_chunks()}, attributes)


def _tared(tare: str, values: AnyArray, level: Floats, axes: int) -> Floats:
    """Return what is taken off each channel (channel,); ``level`` is the median of the first seconds."""
    import numpy as np

    from tacpipe.signals.contact import axis_mean_level

    if tare == "median":
        return level
    if tare == "first":
        first: Floats = values[0].astype(np.float64)
        return first
    if tare == "axis_mean":
        return axis_mean_level(values, axes)
    raise TacpipeError(f"tare is {tare!r}; it must be median, first or axis_mean.")


def _rest(which: str, values: AnyArray, t_ns: Times, rest_s: float) -> tuple[Floats, Bools | None]:
    """Return each channel's level without load (channel,), and the rows (time,) it is of; None: those of the start."""
    import numpy as np

    from tacpipe.signals.contact import lowest_part, rest_level

    if which == "start" or not len(t_ns):
        return rest_level(values, t_ns, rest_s), None
    rows = lowest_part(values, t_ns, rest_s)
    level: Floats = np.median(values[rows], axis=0).astype(np.float64)
    return level, rows


def _unit(table: pa.Table, names: Sequence[str]) -> str:
    """Return the unit of a stream's channels; the empty text where they have none, or not all the same."""
    units = {(table.field(name).metadata or {}).get(b"unit", b"").decode() for name in names}
    return next(iter(units)) if len(units) == 1 else ""


def _check_levels(params: Params, name: str, units: Mapping[str, str], fixed: Collection[str]) -> None:
    """Refuse thresholds in a unit that no stream has: they would do nothing."""
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


def _given(params: Params, found: Thresholds) -> Thresholds:
    """Return the thresholds of a stream in another unit than counts: those given, else those ``found``."""
    from tacpipe.signals.contact import ENDS

    on = found.on if params.on_level is None else params.on_level
    return found._replace(on=on, off=ENDS * on if params.off_level is None else params.off_level)


def _threshold_attributes(
    units: Mapping[str, str], limits: Sequence[Thresholds], fixed: Collection[str]
) -> dict[str, Attribute]:
    """Return the attributes that record by which thresholds streams other than the ``fixed`` were segmented."""
    described: dict[str, Attribute] = {}
    for (stream, unit), (on, off) in zip(units.items(), limits, strict=True):
        if stream not in fixed and math.isfinite(on):
            begins = f"{stream}_contact" if stream else "contact"
            described |= {f"{begins}_on": on, f"{begins}_off": off, f"{begins}_unit": unit}
    return described


def _no_contact(
    params: Params,
    units: Mapping[str, str],
    limits: Sequence[Thresholds],
    largest: Sequence[float],
    fixed: Collection[str],
) -> str:
    """Return the note on a recording without a contact: thresholds, largest load, and what to do."""
    found = [
        f"{stream or 'the sensor'} starts contact at a load of {_number(on)} {unit}".rstrip()
        + f" and reaches {_number(most)} {unit}".rstrip()
        if math.isfinite(on)
        else f"{stream or 'the sensor'} never leaves its level at rest"
        for (stream, unit), (on, _), most in zip(units.items(), limits, largest, strict=True)
    ]
    names = ["--on-count"] * bool(fixed) + ["--on-level"] * (set(fixed) != set(units))
    other = ", or give --thresholds noise" if fixed else ""
    return (
        f"no contact of {params.min_s:g} s or more was found in this recording: {'; '.join(found)}. If something was "
        f"touched, lower {' and '.join(names)}{other}."
    )


def _number(value: float) -> str:
    """Return a number with three digits that count, without an exponent where it can be."""
    return f"{float(f'{value:.3g}'):g}"


def _sensors(name: str, table: pa.Table) -> dict[str, list[str]]:
    """Return the tactile columns of each stream, taxel by taxel."""
    found: dict[str, list[str]] = {}
    for field in table.schema:
        metadata = field.metadata or {}
        if metadata.get(b"quantity") == b"tactile":
            found.setdefault(metadata.get(b"stream", b"").decode(), []).append(field.name)
    if not found:
        raise absent(name, "tactile", table.schema)
    return found


def _proximity(name: str, channel: str, table: pa.Table) -> str:
    """Return the column with the distance of the object."""
    found: list[str] = [field.name for field in table.schema if (field.metadata or {}).get(b"quantity") == b"proximity"]
    if channel:
        if channel not in table.column_names:
            raise TacpipeError(
                f"Recording {name} has no column {channel}; proximity is in {', '.join(found) or 'none'}."
            )
        return channel
    if not found:
        raise absent(name, "proximity", table.schema, unit="mm")
    if len(found) != 1:
        raise TacpipeError(
            f"Recording {name} has {len(found)} columns whose quantity is proximity, and slip is detected in one. "
            f"Give a synchronized dataset with such a stream, and choose with `--channel` where there are several."
        )
    return found[0]


def _no_distance(name: str, channel: str, unit: str, table: pa.Table) -> TacpipeError:
    """Return the error of a proximity in another unit than counts or a length."""
    stream = (table.field(channel).metadata or {}).get(b"stream", b"").decode()
    return TacpipeError(
        f"Recording {name}: {channel} is in {unit}, and slip is detected in counts or in {', '.join(METRES)}. Set unit in "
        f"{entry(stream)} of the layout file, with scale where the file has another unit, and ingest again."
    )


def _rate_hz(name: str, t_ns: Times) -> float:
    """Return how many rows there are a second. Raises `TacpipeError` where their steps are not even."""
    import numpy as np

    if len(t_ns) < 2:
        raise TacpipeError(f"Recording {name} has {len(t_ns)} rows; slip shows in two or more. Exclude the recording.")
    steps_ns = np.diff(t_ns)
    mean_ns = float(steps_ns.mean())
    if not mean_ns > 0 or np.abs(steps_ns - mean_ns).max() > EVEN * mean_ns:
        raise TacpipeError(
            f"Recording {name} has rows {steps_ns.min() / 1e6:g} to {steps_ns.max() / 1e6:g} ms apart, and slip is detected "
            f"on even ones. Synchronize with `--grid uniform`."
        )
    return 1e9 / mean_ns
