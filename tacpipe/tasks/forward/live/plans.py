"""Where the planned motion of a live session comes from, as the rig has it."""

from __future__ import annotations

import ipaddress
from dataclasses import replace

from tacpipe.errors import UsageError
from tacpipe.links import network
from tacpipe.links.link import Address
from tacpipe.live.settings import MEASURED
from tacpipe.printable import excerpt, listed, plain
from tacpipe.recording import rig as rigs
from tacpipe.recording.rig import Rig, Stream
from tacpipe.sensors.plan import NAME as PLAN

LOCAL = "127.0.0.1"  # default host of plans by UDP
RIG = "rig"  # scheme of a plan from one of the rig's own streams


def with_plan(rig: Rig, plan: str, sender: str = "") -> Rig:
    """Return a rig with a stream of plans that come from an address; with ``measured``, or one of the rig's own, as it is.

    ``sender`` is the address of the only computer whose plans are accepted by UDP; a port that other computers can reach
    needs one. Raises `UsageError` for what is no address, and where the rig has a stream of that name, or lacks that which
    is named.
    """
    if sender:
        _check_sender(sender, plan)
    if plan == MEASURED or targets_of(rig, plan):
        return rig
    if PLAN in rig.streams:
        raise UsageError(f"The rig file has a stream {PLAN} already; leave --plan out, and its plans are read.")
    scheme, colon, place = plan.partition(":")
    if scheme not in ("udp", "ws") or not colon or not place:
        raise UsageError(
            f"--plan {excerpt(plan)} is not a source of plans; give {MEASURED}, udp::PORT, ws:HOST:PORT or rig:STREAM."
        )
    if scheme == "udp":
        place = _guarded(place, sender)
    stream = Stream(PLAN, "plan", rigs.make("plan", {}, "--plan"), Address(scheme, place))
    return replace(rig, streams={**rig.streams, PLAN: stream})


def _check_sender(sender: str, plan: str) -> None:
    try:
        ipaddress.ip_address(sender)
    except ValueError:
        raise UsageError(f"--plan-from {excerpt(sender)} is not an IP address, as 192.168.1.20.") from None
    if not plan.startswith("udp:"):
        raise UsageError(f"--plan-from {excerpt(sender)} has no effect without --plan udp:HOST:PORT.")


def _guarded(place: str, sender: str) -> str:
    """Return the place of a UDP port that only this computer, or only the sender, can send plans to."""
    place, _, option = place.partition("?")
    if option and sender:
        raise UsageError(f"--plan-from {excerpt(sender)}: leave ?{plain(option)} of --plan out.")
    host, port = network.place("udp", place)
    host = host or LOCAL
    if sender:
        option = f"sender={sender}"
    elif not option and not _is_loopback(host):
        raise UsageError(
            f"--plan udp:{place} is reached by other computers, and a plan changes forecasts and alarms; give the address "
            f"of the controller with --plan-from, or listen to this computer with udp::{port}."
        )
    return (f"[{host}]:{port}" if ":" in host else f"{host}:{port}") + (f"?{option}" if option else "")


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


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
