"""The pace at which a link is read: whether this program was itself held up, and how late that made what it read.

A read returns within the time that it was given, and what is done between two reads takes next to none. Where more passed,
the program was stopped, starved of a processor, or suspended along with the computer. What had waited meanwhile is stamped
when it is read, so all that is known of its arrival is that it lies after the read before.
"""

from __future__ import annotations

from dataclasses import dataclass

STALL_NS = 100_000_000  # beyond what a read may take; less is the ordinary delay of a busy computer
WAITED_NS = 300_000  # a read that took longer found the link empty at first
CATCH_UP_NS, MOST_CATCH_UP_NS = 50_000_000, 1_000_000_000  # for which arrivals are uncertain after a stall: least, most


@dataclass(frozen=True)
class Stall:
    """Time in which a link was not read."""

    lasted_ns: int
    late_ns: int  # by how much what was read first after it may have come earlier than it is stamped
    suspended_ns: int = 0  # of it, with the whole computer suspended: the monotonic clock stood still

    @property
    def detail(self) -> str:
        """The stall as the detail of a note."""
        return f"{self.lasted_ns} {self.late_ns} {self.suspended_ns}"


def parsed(detail: str) -> Stall | None:
    """Return the stall that the detail of a note gives, None for one that gives none.

    >>> parsed(Stall(5, 7).detail), parsed("unplugged")
    (Stall(lasted_ns=5, late_ns=7, suspended_ns=0), None)
    """
    try:
        lasted_ns, late_ns, suspended_ns = map(int, detail.split())
    except ValueError:
        return None
    sound = min(lasted_ns, late_ns, suspended_ns) >= 0 and max(lasted_ns, late_ns, suspended_ns) < 1 << 62
    return Stall(lasted_ns, late_ns, suspended_ns) if sound else None


class Pace:
    """Follows the reads of one link, each with the time that it was given."""

    def __init__(self, now_ns: int, suspended_ns: int) -> None:
        self._catching_up = False  # what is read had waited
        self._empty_ns = now_ns  # when the link was last known to hold nothing that waits
        self._suspended_ns = suspended_ns  # in all, since the computer was started
        self._over_ns = 0  # when the last stall was over

    def resume(self, now_ns: int) -> None:
        """Take note that the link was used otherwise: a device may have taken the time that passed since the last read."""
        self._empty_ns = now_ns

    def read(self, began_ns: int, ended_ns: int, given_ns: int, suspended_ns: int) -> Stall | None:
        """Take note of a read; return the stall that was over with it, None for none."""
        asleep_ns, self._suspended_ns = suspended_ns - self._suspended_ns, suspended_ns
        asleep_ns = asleep_ns if asleep_ns > STALL_NS else 0  # the clocks are read one after the other
        before_ns, self._empty_ns = self._empty_ns, ended_ns
        lasted_ns = max(began_ns - before_ns, ended_ns - began_ns - given_ns) + asleep_ns
        if lasted_ns > STALL_NS:
            self._catching_up, self._over_ns = True, ended_ns
            return Stall(lasted_ns, ended_ns - before_ns + asleep_ns, asleep_ns)
        return None

    def caught_up(self, began_ns: int, ended_ns: int) -> bool:
        """Return whether this read is the first after a stall that had to wait for the device: all that waited is read."""
        since_ns = ended_ns - self._over_ns
        waited = ended_ns - began_ns > WAITED_NS and since_ns > CATCH_UP_NS
        if not self._catching_up or not (waited or since_ns > MOST_CATCH_UP_NS):
            return False
        self._catching_up = False
        return True
