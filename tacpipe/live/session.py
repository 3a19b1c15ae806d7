"""A live session: the rig recorded as ever, with three streams of its own for what the model's process publishes."""

from __future__ import annotations

import contextlib
import gc
import socket
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from tacpipe.errors import UsageError
from tacpipe.links.link import Address
from tacpipe.live.alarms import NAMES
from tacpipe.live.options import OWN, Options
from tacpipe.live.settings import MEASURED
from tacpipe.live.supervisor import Supervisor
from tacpipe.live.tap import Tap
from tacpipe.printable import excerpt, listed
from tacpipe.recording import rig as rigs
from tacpipe.recording import rig_text
from tacpipe.recording.recorder import Recorder
from tacpipe.recording.rig import Rig, Stream
from tacpipe.sensors.plan import NAME as PLAN

ANSWERS = {"forecast": "forecasts", "material": "materials named", "touch": "rankings"}  # by kind of message
RIG = "rig"  # scheme of a plan from one of the rig's own streams
SWITCH_S = 0.0005  # that one thread may hold up another: the threads that read must not wait 5 ms for the view


@dataclass(frozen=True)
class Described:
    """What the model predicts, which the session's own streams must state before it runs."""

    channels: tuple[str, ...]
    horizon: int
    unit: str
    percents: tuple[int, ...] = ()  # levels of the quantiles that it has
    quantiles: tuple[int, ...] = ()  # those of them that are asked for
    kind: ClassVar[str] = "forecast"  # of its messages

    def own(self, steps: Sequence[int]) -> dict[str, Mapping[str, Any]]:
        """Return the session's own streams, with the options of the sensor ``live``."""
        forecast = {"output": "forecast", "channels": list(self.channels), "steps": list(steps), "unit": self.unit}
        levels = {"quantiles": list(self.quantiles)} if self.quantiles else {}
        return {
            "forecast": {**forecast, **levels},
            "alarm": {"output": "alarm", "alarms": list(NAMES)},
            "latency": {"output": "latency"},
        }


@dataclass(frozen=True)
class Surfaces:
    """The materials that the model names."""

    names: tuple[str, ...]
    kind: ClassVar[str] = "material"

    def own(self, steps: Sequence[int]) -> dict[str, Mapping[str, Any]]:
        """Return the session's own streams, with the options of the sensor ``live``."""
        return {"material": {"output": "material", "channels": list(self.names)}, "latency": {"output": "latency"}}


def with_plan(rig: Rig, plan: str) -> Rig:
    """Return a rig with a stream of plans that come from an address; with ``measured``, or one of the rig's own, as it is.

    Raises `UsageError` for what is no address, and where the rig has a stream of that name, or lacks that which is named.
    """
    if plan == MEASURED or targets_of(rig, plan):
        return rig
    if PLAN in rig.streams:
        raise UsageError(f"The rig file has a stream {PLAN} already; leave --plan out, and its plans are read.")
    scheme, colon, place = plan.partition(":")
    if scheme not in ("udp", "ws") or not colon or not place:
        raise UsageError(
            f"--plan {excerpt(plan)} is not a source of plans; give {MEASURED}, udp::PORT, ws:HOST:PORT or rig:STREAM."
        )
    stream = Stream(PLAN, "plan", rigs.make("plan", {}, "--plan"), Address(scheme, place))
    return replace(rig, streams={**rig.streams, PLAN: stream})


@dataclass(frozen=True)
class Grasped:
    """What the model predicts of a grasp."""

    columns: tuple[str, ...]
    kind: ClassVar[str] = "touch"

    def own(self, steps: Sequence[int]) -> dict[str, Mapping[str, Any]]:
        """Return the session's own streams, with the options of the sensor ``live``."""
        return {"touch": {"output": "touch", "channels": list(self.columns)}, "latency": {"output": "latency"}}


def targets_of(rig: Rig, plan: str) -> str:
    """Return the stream that ``rig:STREAM`` names, empty for any other source. Raises `UsageError` where there is none."""
    scheme, _, stream = plan.partition(":")
    if scheme != RIG:
        return ""
    if stream not in rig.streams:
        raise UsageError(
            f"--plan {excerpt(plan)}: the rig has no stream {excerpt(stream)}; it has {listed(rig.streams)}."
        )
    return stream


def with_own(rig: Rig, about: Described | Surfaces | Grasped, steps: Sequence[int]) -> Rig:
    """Return a rig with the session's own streams, as ``forecast`` and ``latency``, at free ports of this computer.

    Raises `UsageError` where it has streams of these names, and for forecasts too large for a packet.
    """
    taken = [name for name in OWN if name in rig.streams]
    if taken:
        raise UsageError(f"The rig file has a stream {taken[0]}, as a live session adds itself; give it another name.")
    options = about.own(steps)
    added = {
        name: Stream(name, "live", rigs.make("live", found, "live"), Address("udp", f"127.0.0.1:{port}"), found)
        for (name, found), port in zip(options.items(), free_ports(len(options)), strict=True)
    }
    made = replace(rig, streams={**rig.streams, **added})
    return replace(made, text=rig_text.of(made))


def free_ports(count: int) -> list[int]:
    """Return UDP ports of this computer that nobody listens on."""
    with contextlib.ExitStack() as held:
        found = []
        for _ in range(count):
            one = held.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            one.bind(("127.0.0.1", 0))
            found.append(int(one.getsockname()[1]))
    return found


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
