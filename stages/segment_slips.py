"""Mark slips and drops of a held object.

They are detected from the object's distance to the wrist. Adds the labels ``slip``, detected from the whole
recording, ``slip_online``, detected from the rows so far, and ``dropped``. Run it after ``segment contacts``: each
contact is a grasp, and a drop lasts until the next one. Without the column ``contact``, the whole recording is one.
There is no slip outside of contacts, after a drop, or without a reading. Rows need a constant rate, as from
``synchronize --rate-hz 50``.

Example: tacpipe segment slips data/even-contacts -o data/slips
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated

from tacpipe.channels.arm import METRES
from tacpipe.channels.streams import COUNT, columns_with_quantity, common_unit, layout_entry, missing_channel_error
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.plugins.constraints import NonNegativeFloat, PositiveFloat, PositiveInt, Unit
from tacpipe.plugins.stage import stage
from tacpipe.plugins.stream_selection import StreamSelection

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import Times
    from tacpipe.datasets.dataset import Recording
    from tacpipe.io.columns import Columns

EVEN = 0.01  # maximum relative difference between steps that a filter for even steps accepts


@dataclass(frozen=True)
class Params(StreamSelection):
    """Criteria for slip and drop in the readings of a proximity sensor that faces the grasped object.

    Thresholds are in multiples of the noise of the readings' rate after the grasp. Readings in a unit of length are
    converted to counts with ``count_per_mm``, and never saturate. One millimetre is 8 counts on the published rig, its
    fingers' patch is 25 mm, its noise 0.8 counts and its smallest reading 544.
    """

    channel: str = ""  # column with the readings; empty: the only one whose quantity is proximity
    # cut-off of the low-pass filter applied before the rate is computed
    cutoff_hz: Annotated[PositiveFloat, Unit("Hz")] = 5.0
    # duration without slip after the grasp, from which noise and level are estimated
    still_s: Annotated[PositiveFloat, Unit("s")] = 0.5
    on_sigma: PositiveFloat = 5.0  # rate above which a slip starts, in multiples of its noise
    off_sigma: PositiveFloat = 2.0  # rate below which a slip ends, in multiples of its noise
    on_frames: PositiveInt = 3  # number of consecutive rows above on_sigma that start a slip
    off_frames: PositiveInt = 5  # number of consecutive rows below off_sigma that end a slip
    # minimum noise of the rate; a change of one count is a rate of 10
    noise_floor: Annotated[PositiveFloat, Unit("count/s")] = 3.0
    # maximum change of readings that counts as no change of level
    level_count: Annotated[PositiveFloat, Unit("count")] = 0.75
    patch_mm: Annotated[PositiveFloat, Unit("mm")] = 25.0  # slipped distance at which an object is lost
    count_per_mm: Annotated[PositiveFloat, Unit("count/mm")] = 8.0  # sensitivity of the sensor
    # maximum reading of a lost object: nothing is within the sensor's range
    saturated_count: Annotated[NonNegativeFloat, Unit("count")] = 544.0

    def check(self) -> None:
        """Raise `UsageError` for slips that end above their start level."""
        if self.off_sigma > self.on_sigma:
            raise UsageError(
                f"off_sigma is {self.off_sigma:g}, above on_sigma, {self.on_sigma:g}; a slip must end at or below the rate "
                f"at which it begins."
            )


@stage(version=2)
def slips(params: Params, recording: Recording) -> pa.Table | pa.RecordBatchReader:
    """Return the recording with the labels of slips and drops."""
    import numpy as np
    import pyarrow as pa

    from tacpipe.io.columns import change
    from tacpipe.signals import slip

    table = recording.columns()
    if "slip" in table.column_names:
        raise TacpipeError(f"Recording {recording.name} has a column slip already; give what was there before it.")
    channel = _proximity(recording.name, params.channel, table)
    readings, saturated = table.column(channel).to_numpy().astype(np.float64), params.saturated_count
    unit = common_unit(table.schema, [channel])
    if unit in METRES:
        readings, saturated = readings * (1e3 * METRES[unit] * params.count_per_mm), -math.inf
    elif unit not in (COUNT, ""):
        raise _unit_error(recording.name, channel, unit, table)
    t_ns = table.column("t_ns").to_numpy()
    rate_hz = _rate_hz(recording.name, t_ns)
    contact = table.column("contact").to_numpy() if "contact" in table.column_names else np.zeros(len(t_ns))
    still_rows, patch_count = round(params.still_s * rate_hz), params.patch_mm * params.count_per_mm
    limits = slip.SlipLimits(
        on_sigma=params.on_sigma,
        off_sigma=params.off_sigma,
        on_rows=params.on_frames,
        off_rows=params.off_frames,
        noise_floor=params.noise_floor,
        level_count=params.level_count,
    )
    values = slip.fill_missing(readings)
    labels = {name: np.zeros(len(t_ns), dtype=bool) for name in ("slip", "slip_online", "dropped")}
    grasps = np.flatnonzero((contact >= 0) & (np.diff(contact, prepend=-1) != 0)).tolist()
    for rows in (slice(*ends) for ends in pairwise([*grasps, len(t_ns)])):  # each grasp has a separate level and noise
        grasp_values, is_held = values[rows], (contact[rows] >= 0) & np.isfinite(readings[rows])
        lost = slip.dropped(grasp_values, still_rows, patch_count, saturated)
        lost_online = slip.dropped_online(grasp_values, still_rows, patch_count, saturated)
        labels["dropped"][rows] = lost
        labels["slip"][rows] = (
            is_held & ~lost & slip.slip_offline(grasp_values, rate_hz, params.cutoff_hz, still_rows, limits)
        )
        is_slipping = slip.slip_online(grasp_values, rate_hz, params.cutoff_hz, still_rows, limits)
        labels["slip_online"][rows] = is_held & ~lost_online & is_slipping
    label = {"unit": "1", "quantity": "label"}

    def add_labels(rows: pa.Table, first: int) -> pa.Table:
        for name, flags in labels.items():
            values = pa.array(flags[first : first + rows.num_rows].astype(np.int8))
            rows = rows.append_column(pa.field(name, pa.int8(), metadata=label), values)
        return rows

    return change(table, add_labels)


def _proximity(name: str, channel: str, table: Columns) -> str:
    """Return the column with the object's distance: ``channel``, or the only one.

    Raises `TacpipeError` if there is none.
    """
    proximity_columns = columns_with_quantity(table, "proximity")
    if channel:
        if channel not in table.column_names:
            raise TacpipeError(
                f"Recording {name} has no column {channel}; proximity is in {', '.join(proximity_columns) or 'none'}."
            )
        return channel
    if not proximity_columns:
        raise missing_channel_error(name, "proximity", table.schema, unit="mm")
    if len(proximity_columns) != 1:
        raise TacpipeError(
            f"Recording {name} has {len(proximity_columns)} columns whose quantity is proximity, and slip is detected in "
            f"one. Give a synchronized dataset with such a stream, and choose with `--channel` where there are several."
        )
    return proximity_columns[0]


def _unit_error(name: str, channel: str, unit: str, table: Columns) -> TacpipeError:
    """Return the error for a proximity in a unit other than counts or a length."""
    stream = (table.schema.field(channel).metadata or {}).get(b"stream", b"").decode()
    return TacpipeError(
        f"Recording {name}: {channel} is in {unit}, and slip is detected in counts or in {', '.join(METRES)}. Set unit in "
        f"{layout_entry(stream)} of the layout file, with scale where the file has another unit, and ingest again."
    )


def _rate_hz(name: str, t_ns: Times) -> float:
    """Return the number of rows per second. Raises `TacpipeError` if the steps are not even."""
    import numpy as np

    if len(t_ns) < 2:
        raise TacpipeError(f"Recording {name} has {len(t_ns)} rows; slip shows in two or more. Exclude the recording.")
    steps_ns = np.diff(t_ns)
    mean_ns = float(steps_ns.mean())
    if not mean_ns > 0 or np.abs(steps_ns - mean_ns).max() > EVEN * mean_ns:
        raise TacpipeError(
            f"Recording {name} has rows {steps_ns.min() / 1e6:g} to {steps_ns.max() / 1e6:g} ms apart, and slip is detected "
            f"on even ones. Synchronize with --rate-hz, as --rate-hz 50."
        )
    return 1e9 / mean_ns
