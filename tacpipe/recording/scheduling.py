"""Real-time scheduling: the threads of a recording run before all ordinary programs, and before those of a model.

``nice`` is no substitute: if the kernel groups processes by session (``sched_autogroup_enabled``, as on most desktops),
it only affects programs of one terminal.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from tacpipe.errors import UsageError

RECORDER, MODEL = 20, 10  # priorities, so that the recording never waits for the model


def check_realtime() -> None:
    """Raise `UsageError` if the system does not allow real-time scheduling."""
    try:
        _set(0, RECORDER)
    except (OSError, AttributeError) as error:
        raise UsageError(
            f"--realtime: real-time scheduling is not allowed here ({error}). Run the command as root, or have "
            f"`@realtime - rtprio {RECORDER}` in /etc/security/limits.d and this user in that group; or leave it out."
        ) from error
    ordinary()


def realtime(priority: int) -> None:
    """Run all threads of this process before ordinary programs, if permitted."""
    for thread in _threads():
        with contextlib.suppress(OSError):  # the thread may have ended
            _set(thread, priority)


def ordinary() -> None:
    """Schedule all threads of this process normally again."""
    for thread in _threads():
        with contextlib.suppress(OSError):
            os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))


def _set(thread: int, priority: int) -> None:
    os.sched_setscheduler(thread, os.SCHED_RR, os.sched_param(priority))


def _threads() -> list[int]:
    return [int(thread.name) for thread in Path("/proc/self/task").iterdir()]
