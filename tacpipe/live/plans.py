"""Read the planned motion of a live session: add its stream to a rig, and keep the plans that have arrived."""

from __future__ import annotations

import bisect
import ipaddress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Floats, Times
from tacpipe.errors import UsageError
from tacpipe.links import network
from tacpipe.links.link import Address
from tacpipe.live.decoding import BatchColumns
from tacpipe.printable import excerpt, listed, plain
from tacpipe.recording import rig as rigs
from tacpipe.recording.rig import Rig, RigStream
from tacpipe.sensors.plan import MEASURED, POSE
from tacpipe.sensors.plan import NAME as PLAN

LOCAL = "127.0.0.1"  # default host of plans by UDP
RIG = "rig"  # scheme of a plan from a stream of the rig


def with_plan(rig: Rig, plan: str, sender: str = "") -> Rig:
    """Return a rig with a stream of plans from an address; unchanged for ``measured`` or a stream of the rig.

    ``sender`` is the only IP address from which plans are accepted by UDP; it is required for a port that other
    computers can reach. Raises `UsageError` if the address is invalid, or the rig already has a stream of that name or
    lacks the given one.
    """
    if sender:
        _check_sender(sender, plan)
    if plan == MEASURED or target_stream(rig, plan):
        return rig
    if PLAN in rig.streams:
        raise UsageError(f"The rig file has a stream {PLAN} already; leave --plan out, and its plans are read.")
    scheme, colon, place = plan.partition(":")
    if scheme not in ("udp", "ws") or not colon or not place:
        raise UsageError(
            f"--plan {excerpt(plan)} is not a source of plans; give {MEASURED}, udp::PORT, ws:HOST:PORT or rig:STREAM."
        )
    if scheme == "udp":
        place = _restrict_address(place, sender)
    stream = RigStream(PLAN, "plan", rigs.build_sensor("plan", {}, "--plan"), Address(scheme, place))
    return replace(rig, streams={**rig.streams, PLAN: stream})


def _check_sender(sender: str, plan: str) -> None:
    try:
        ipaddress.ip_address(sender)
    except ValueError:
        raise UsageError(f"--plan-from {excerpt(sender)} is not an IP address, as 192.168.1.20.") from None
    if not plan.startswith("udp:"):
        raise UsageError(f"--plan-from {excerpt(sender)} has no effect without --plan udp:HOST:PORT.")


def _restrict_address(place: str, sender: str) -> str:
    """Return the address of a UDP port that accepts plans from this computer, or from the sender, only.

    Raises `UsageError` if other computers reach it and no sender is named, or two are.
    """
    place, _, option = place.partition("?")
    if option and sender:
        raise UsageError(f"--plan-from {excerpt(sender)}: leave ?{plain(option)} of --plan out.")
    host, port = network.parse_host_port("udp", place)
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


def target_stream(rig: Rig, plan: str) -> str:
    """Return the stream in ``rig:STREAM``, or empty for any other source. Raises `UsageError` if there is no such stream."""
    scheme, _, stream = plan.partition(":")
    if scheme != RIG:
        return ""
    if stream not in rig.streams:
        raise UsageError(
            f"--plan {excerpt(plan)}: the rig has no stream {excerpt(stream)}; it has {listed(rig.streams)}."
        )
    return stream


class PosePlan(NamedTuple):
    """Planned poses of the hand: times, and positions in m with quaternions x, y, z, w."""

    t_ns: Times  # (point,), ascending
    poses: Floats  # (point, 7), position and quaternion; the hand does not turn if a quaternion is not finite


class PlanHistory:
    """The plans that have arrived. Each plan replaces the previous one."""

    def __init__(self) -> None:
        self._arrived: list[int] = []  # (plan,), ascending
        self._parts: list[list[Floats]] = []  # (plan,), rows of time and pose, in one or more batches

    def push(self, batch: pa.RecordBatch | pa.Table | BatchColumns) -> Times:
        """Add rows of the stream of plans in the order of their arrival, and return the arrivals of their plans.

        Rows with the same arrival are one plan, also if they are in several batches.
        """
        if not batch.num_rows:
            return np.zeros(0, np.int64)
        names = batch.schema.names
        arrived: Times = np.asarray(batch.column(names.index("t_ns")), np.int64)
        # times as the bits of floats, so that a plan's rows are one array
        target = np.ascontiguousarray(batch.column(names.index("t_target_ns"))).view(np.float64)
        poses: Floats = np.column_stack([np.asarray(batch.column(names.index(name))) for name in POSE])
        rows = np.column_stack([target, poses])
        arrivals = np.unique(arrived)
        for arrived_ns in arrivals.tolist():
            plan_rows = rows[arrived == arrived_ns]
            if self._arrived and self._arrived[-1] == arrived_ns:
                self._parts[-1].append(plan_rows)
            else:
                self._arrived.append(arrived_ns)
                self._parts.append([plan_rows])
        return arrivals

    def arrival(self, t_ns: int) -> int | None:
        """Return when the newest plan at a time arrived, or None before the first plan."""
        place = bisect.bisect_right(self._arrived, t_ns) - 1
        return None if place < 0 else self._arrived[place]

    def newest(self, t_ns: int) -> PosePlan | None:
        """Return the newest plan at a time, or None before the first plan."""
        place = bisect.bisect_right(self._arrived, t_ns) - 1
        if place < 0:
            return None
        rows = np.concatenate(self._parts[place])
        return PosePlan(rows[:, 0].view(np.int64), rows[:, 1:])

    def forget_before(self, t_ns: int) -> None:
        """Drop the plans that a newer plan had replaced at a time."""
        place = max(0, bisect.bisect_right(self._arrived, t_ns) - 1)
        del self._arrived[:place], self._parts[:place]
