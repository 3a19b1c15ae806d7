"""Real-time scheduling of a session: its threads run before all ordinary programs, those of the recorder before the model.

The priority of ``nice`` is no substitute: where the kernel groups processes by session (``sched_autogroup_enabled``, as most
desktops have it), it counts among the programs of one terminal alone.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from tacpipe.errors import UsageError

RECORDER, MODEL = 20, 10  # priorities: the recording never waits for the model


def check() -> None:
    """Raise `UsageError` where the system does not allow real-time scheduling."""
    try:
        _set(0, RECORDER)
    except (OSError, AttributeError) as error:
        raise UsageError(
            f"--realtime: real-time scheduling is not allowed here ({error}). Run the session as root, or have "
            f"`@realtime - rtprio {RECORDER}` in /etc/security/limits.d and this user in that group; or leave it out."
        ) from error
    ordinary()


def realtime(priority: int) -> None:
    """Have all threads of this process run before ordinary programs; without the right to, they stay as they are."""
    for thread in _threads():
        with contextlib.suppress(OSError):  # the thread may have ended
            _set(thread, priority)


def ordinary() -> None:
    """Have all threads of this process scheduled as ever."""
    for thread in _threads():
        with contextlib.suppress(OSError):
            os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))


def _set(thread: int, priority: int) -> None:
    os.sched_setscheduler(thread, os.SCHED_RR, os.sched_param(priority))


def _threads() -> list[int]:
    return [int(thread.name) for thread in Path("/proc/self/task").iterdir()]
