"""Determine whether the times of a stream are arrivals, and when its samples were measured.

Commands and live sessions use the same class, with the columns of times and counters that the stream has.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import Times
from tacpipe.channels.schema import declared_period_ns, has_arrivals
from tacpipe.plugins.stage import Attribute
from tacpipe.signals.sampling import BURST_FRACTION, PlacedSamples, SamplingClock, spread_times

if TYPE_CHECKING:
    import pyarrow as pa

TIME, COUNTER, DEVICE, LOG = "t_ns", "seq", "t_device_ns", "t_log_ns"
ENDED = "ended"  # attribute of acquired recordings, whose times are arrivals


def are_arrivals(field: pa.Field, attributes: Mapping[str, Attribute], equal_fraction: float) -> bool:
    """Return whether the times of a stream are arrivals, from its field ``t_ns`` and its recording's attributes.

    ``equal_fraction`` is the fraction of stamps that equal the previous one. Recordings of older versions do not state what
    their times are.
    """
    return has_arrivals(field) or ENDED in attributes or equal_fraction > BURST_FRACTION


def equal_fraction(table: pa.Table) -> float:
    """Return the fraction of stamps of a stream that equal the previous one."""
    return float((np.diff(table.column("t_ns").to_numpy()) == 0).sum() / table.num_rows)


class Placement:
    """Places the samples of one stream, batch by batch. The results do not depend on the batches."""

    def __init__(self, schema: pa.Schema, *, arrivals: bool) -> None:
        """Read the columns of times and counters in ``schema``; ``arrivals`` states whether its times are arrivals."""
        time = schema.field(TIME)
        optional = (COUNTER, DEVICE) if arrivals else (LOG,)
        # names of the integer columns that `place` reads
        self.columns = (TIME, *(name for name in optional if name in schema.names and _is_integer(schema, name)))
        self._clock = SamplingClock(declared_period_ns(time)) if arrivals else None
        self._newest_ns: int | None = None  # sampling time of the newest sample, if times are not arrivals
        self._arrived_ns: int | None = None  # its arrival

    def place(self, times: Mapping[str, Times]) -> tuple[Times, PlacedSamples]:
        """Return the arrivals (time,) of the next samples, which do not decrease, and their sampling times.

        ``times`` contains `columns`, each (time,). Without arrivals, times are sampling times, of which equal ones are
        spread by 1 ns each, and a log time is the arrival.
        """
        t_ns = times[TIME]
        if self._clock is not None:
            return t_ns, self._clock.place(t_ns, times.get(COUNTER), times.get(DEVICE))
        if not len(t_ns):
            return t_ns, PlacedSamples(t_ns, t_ns, np.zeros(0, bool), np.zeros(0, bool))
        spread_ns = spread_times(t_ns, self._newest_ns)
        arrival_ns = np.maximum(times.get(LOG, t_ns), t_ns)
        if self._arrived_ns is not None:
            arrival_ns = np.maximum(arrival_ns, self._arrived_ns)
        arrival_ns = np.maximum.accumulate(arrival_ns)
        self._newest_ns, self._arrived_ns = int(spread_ns[-1]), int(arrival_ns[-1])
        unmarked = np.zeros(len(t_ns), bool)
        return arrival_ns, PlacedSamples(spread_ns, np.maximum(arrival_ns, spread_ns), unmarked, unmarked)


def _is_integer(schema: pa.Schema, name: str) -> bool:
    import pyarrow as pa

    return bool(pa.types.is_integer(schema.field(name).type))
