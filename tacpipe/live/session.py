"""A live session: the rig recorded as ever, next to the model's process."""

from __future__ import annotations

import contextlib
import gc
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from tacpipe.live.options import Options
from tacpipe.live.supervisor import Supervisor
from tacpipe.live.tap import Tap
from tacpipe.recording.recorder import Recorder

ANSWERS = {"forecast": "forecasts", "material": "materials named", "touch": "rankings"}  # by kind of message
SWITCH_S = 0.0005  # that one thread may hold up another: the threads that read must not wait 5 ms for the view


@contextlib.contextmanager
def running(recorder: Recorder, options: Options, ended: Callable[[], bool]) -> Iterator[Supervisor]:
    """Have the model's process follow a rig while in the block. Raises what it refuses the session with."""
    supervisor = Supervisor(options, Tap(options.streams))
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    try:
        supervisor.start(ended)
        recorder.accompany(supervisor, options.streams)
        gc.collect()
        gc.freeze()  # what is there stays: looking through it all would hold up the threads that read for 20 ms and more
        yield supervisor
    finally:
        gc.unfreeze()
        supervisor.stop()
        sys.setswitchinterval(before_s)


def lines(figures: Mapping[str, Any]) -> list[str]:
    """Return what a session did so far in words.

    >>> lines({"forecasts": 9, "skipped": 1, "restarts": 0, "states": {"load": "off", "slip": "unknown"},
    ...     "cause": "", "latency": {"count": 9, "p50_ms": 4.2, "p99_ms": 6.0, "max_ms": 6.5}})
    ['forecasts 9, skipped 1; latency median 4.2 ms, 99 % 6.0 ms, largest 6.5 ms; load off, slip unknown']
    """
    latency = figures.get("latency") or {}
    kind = figures.get("kind", "forecast")
    parts = [f"{ANSWERS.get(kind, kind)} {figures.get('forecasts', 0)}, skipped {figures.get('skipped', 0)}"]
    if latency.get("count"):
        parts.append(
            f"latency median {latency['p50_ms']:.1f} ms, 99 % {latency['p99_ms']:.1f} ms, "
            f"largest {latency['max_ms']:.1f} ms"
        )
    states = ", ".join(f"{name} {state}" for name, state in figures.get("states", {}).items())
    parts += [states] if states else []
    for name, what in (
        ("late", "samples late"),
        ("dropped", "messages not taken by subscribers"),
        ("overflows", "times the model's process did not keep up"),
        ("restarts", "restarts of the model's process"),
    ):
        parts += [f"{figures[name]} {what}"] if figures.get(name) else []
    found = ["; ".join(parts)]
    return [*found, f"{kind}: {figures['cause']}"] if figures.get("cause") else found
