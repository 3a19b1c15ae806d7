"""Where the planned motion of a live session comes from, as the rig has it."""

from __future__ import annotations

from dataclasses import replace

from tacpipe.errors import UsageError
from tacpipe.links.link import Address
from tacpipe.live.settings import MEASURED
from tacpipe.printable import excerpt, listed
from tacpipe.recording import rig as rigs
from tacpipe.recording.rig import Rig, Stream
from tacpipe.sensors.plan import NAME as PLAN

RIG = "rig"  # scheme of a plan from one of the rig's own streams


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
