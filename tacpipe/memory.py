"""How much memory is left for this process, so that what a file claims is refused before it is taken."""

from __future__ import annotations

import contextlib
import resource
from pathlib import Path

from tacpipe.errors import TacpipeError

MEMINFO = Path("/proc/meminfo")
STATM = Path("/proc/self/statm")
GROUP = Path("/sys/fs/cgroup")  # of a container: its limit, and what is used of it
AT_HAND = 1 << 26  # bytes that are not worth asking the system about
KEPT = 0.9  # share of what is left that one file may claim


def available() -> int:
    """Return how many bytes this process can still take: by the computer, its container and its own limit."""
    left = [1 << 62]
    with contextlib.suppress(OSError, ValueError, IndexError):
        told = dict(line.split(":", 1) for line in MEMINFO.read_text().splitlines())
        left.append(int(told["MemAvailable"].split()[0]) << 10)
    with contextlib.suppress(OSError, ValueError):  # "max" where there is no limit
        left.append(int((GROUP / "memory.max").read_text()) - int((GROUP / "memory.current").read_text()))
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY:
        with contextlib.suppress(OSError, ValueError, IndexError):
            left.append(limit - int(STATM.read_text().split()[0]) * resource.getpagesize())
    return max(0, min(left))


def require(needed: int, what: str, *, error: type[TacpipeError] = TacpipeError) -> None:
    """Raise ``error``, a `TacpipeError`, where ``what`` needs more memory than is left."""
    if needed <= AT_HAND:
        return
    left = int(available() * KEPT)
    if needed > left:
        raise error(
            f"{what} claims to be {_told(needed)} of data, and {_told(left)} of memory are left. If it is what you expect, "
            f"read it on a computer with more memory or in parts; if it came from a stranger, do not trust it."
        )


def _told(count: int) -> str:
    """Return a number of bytes in a unit that is read at a glance.

    >>> _told(2_500_000_000), _told(10)
    ('2.5 GB', '0.00001 MB')
    """
    return (
        f"{count / 1e9:,.1f} GB"
        if count >= 1e8
        else f"{count / 1e6:g} MB"
        if count >= 1000
        else f"{count / 1e6:.5f} MB"
    )
