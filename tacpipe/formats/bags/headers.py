"""Compare the header stamps of a topic with its log times, and choose which of them time its rows.

A header stamp is the time of measurement, the log time that of arrival. Both are in ns.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from tacpipe.arrays import Int64s
from tacpipe.signals.sampling import BURST_FRACTION

MAX_OFFSET_NS = 60 * 10**9  # maximum difference between a header stamp and its log time if both use the same clock
BLOCKS, BLOCK_ROWS = 32, 4  # maximum number and minimum size of the blocks of a batch whose median delay is kept
MIN_BLOCKS = 9  # number of blocks from which a change of the delay is examined
CHANGE_NS = 5_000_000  # smallest change of the delay that is a drift
APART_NS = 500_000_000  # smallest difference of delays that puts streams out of step
USE_LOG = 'time = { column = "t_log_ns", unit = "ns" } in the layout uses the log times'


class HeaderStamps:
    """The counts of a topic's header stamps that cannot be used, and their delays behind the log times."""

    def __init__(self) -> None:
        """Create the comparison of a topic without rows."""
        self.counts: Counter[str] = Counter()
        self._far_ns = self._later_ns = 0  # greatest difference from the log time, and greatest difference after it
        self._blocks: list[tuple[float, float]] = []  # log time and delay: medians of some rows

    def add(self, header_ns: Int64s, log_ns: Int64s) -> None:
        """Add the stamps of rows (row,)."""
        delay_ns = log_ns - header_ns
        self.counts["rows"] += len(header_ns)
        self.counts["unset"] += int((header_ns == 0).sum())
        self.counts["far"] += int((np.abs(delay_ns) > MAX_OFFSET_NS).sum())
        self.counts["later"] += int((delay_ns < 0).sum())
        self.counts["repeated"] += len(header_ns) - len(np.unique(header_ns))
        self.counts["repeated logs"] += len(log_ns) - len(np.unique(log_ns))
        self._far_ns = max(self._far_ns, int(np.abs(delay_ns).max(initial=0)))
        self._later_ns = max(self._later_ns, int(-delay_ns.min(initial=0)))
        for rows in np.array_split(np.arange(len(log_ns)), min(BLOCKS, -(-len(log_ns) // BLOCK_ROWS))):
            self._blocks.append((float(np.median(log_ns[rows])), float(np.median(np.maximum(delay_ns[rows], 0)))))

    @property
    def delay_ns(self) -> float:
        """The median delay of the header stamps behind the log times; stamps after the log time have none."""
        return float(np.median([delay for _, delay in self._blocks]))

    def problem(self) -> str:
        """Return why the log times are used instead, as a clause, or "" if header stamps are used.

        Stamps of a simulation, of a device clock, or of a clock that was set during the recording would separate
        streams.
        """
        counts = self.counts
        if counts["unset"]:
            return self._share("unset", "are not set")
        if counts["far"]:
            return self._share("far", f"are over 60 s from the log times, by up to {self._far_ns / 1e9:.3g} s")
        if counts["later"] > counts["rows"] / 2:
            return self._share("later", f"are later than the log times, by up to {self._later_ns / 1e9:.3f} s")
        if counts["repeated"] > max(BURST_FRACTION * counts["rows"], 2 * counts["repeated logs"]):
            return self._share("repeated", "repeat another one, as if they were set once for a batch")
        return ""

    def notes(self) -> list[str]:
        """Return clauses about header stamps that are used."""
        notes = []
        if self.counts["later"]:
            later = f"are up to {self._later_ns / 1e9:.3f} s later than the log times; t_ns has the log times there"
            notes.append(self._share("later", later))
        t_ns, delay_ns = np.array(self._blocks).T
        if len(t_ns) < MIN_BLOCKS:
            return notes
        thirds = np.array_split(np.arange(len(t_ns)), 3)
        span_ns, change_ns = (
            float(np.median(values[thirds[2]]) - np.median(values[thirds[0]])) for values in (t_ns, delay_ns)
        )
        noise_ns = float(np.median(np.abs(np.diff(delay_ns))))
        if abs(change_ns) > max(CHANGE_NS, 5 * noise_ns) or np.ptp(delay_ns) > APART_NS:
            notes.append(
                f"the delay of header stamps behind the log times changes between {delay_ns.min() / 1e9:.3f} s and "
                f"{delay_ns.max() / 1e9:.3f} s (by {change_ns / max(span_ns, 1) * 1e6:,.0f} ppm): the clocks drift, one of "
                f"them was set, or messages waited; {USE_LOG}"
            )
        return notes

    def _share(self, name: str, clause: str) -> str:
        return f"{self.counts[name]:,} of {self.counts['rows']:,} header stamps {clause}"
