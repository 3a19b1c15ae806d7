"""Planned motion of the hand, which a controller sends as JSON to a live session. The session records it.

A packet is one plan, which replaces the previous plan::

    {"version": 1, "points": [[T_NS, X, Y, Z, QX, QY, QZ, QW], …]}

Each point is a time in UTC nanoseconds (``time.time_ns()`` of the recording computer), a position in m and a quaternion
in the frame of the recorded pose. Times are ascending. A plan should cover the model's horizon, and be sent again before
it ends.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from tacpipe.channels import schema
from tacpipe.sensors.byte_framer import TextFramer
from tacpipe.sensors.framing import Framer
from tacpipe.sensors.sensor import Samples, Sensor

if TYPE_CHECKING:
    import pyarrow as pa

VERSION = 1
MAX_POINTS = 1000  # per plan
MAX_TIME_NS = 1 << 62
NAME = "plan"  # name of the stream in a rig
MEASURED = "measured"  # used instead of an address of plans: the recorded motion is assumed to continue
POSE = (*(f"position_{axis}_m" for axis in "xyz"), *(f"orientation_{part}" for part in "xyzw"))  # columns
NUMBERS = len(POSE)  # numbers per pose


@dataclass(frozen=True)
class Plan(Sensor):
    """Plans of a controller. A sample is one point of a plan; points of one plan have the same arrival."""

    summary: ClassVar[str] = "Planned motion of a controller, for `tacpipe live`."
    links: ClassVar[tuple[str, ...]] = ("udp", "ws")
    listens: ClassVar[bool] = True
    steady: ClassVar[bool] = False

    rate_hz: float = 0.0  # plans per second; 0: irregular

    def fields(self) -> list[pa.Field]:
        """Return the planned time of a point in UTC ns, and its pose."""
        import pyarrow as pa

        target = pa.field("t_target_ns", pa.int64(), metadata={"unit": "ns", "quantity": "plan"})
        pose = [schema.float_field(name, "m" if name.endswith("_m") else "1", "plan") for name in POSE]
        return [target, *pose]

    def accepts(self, packet: bytes) -> bool:
        """Return whether a packet is a plan. Any program may send packets to the port."""
        return is_plan(packet)

    def framer(self) -> Framer:
        """Return a framer for packets that are plans."""
        return TextFramer(is_plan)

    def decode(self, frames: Sequence[bytes]) -> Samples:
        """Return one sample per point of each plan."""
        plans = [json.loads(frame)["points"] for frame in frames]
        points = [point for plan in plans for point in plan]
        targets = np.array([point[0] for point in points], dtype=np.int64).reshape(-1, 1)
        poses = np.array([point[1:] for point in points], dtype=np.float64).reshape(-1, NUMBERS)
        rows = np.repeat(np.arange(len(plans)), [len(plan) for plan in plans])
        return Samples((targets, poses), rows=rows.astype(np.int64))

    def encode(self, samples: Samples) -> list[bytes]:
        """Return one plan with one point per sample."""
        targets, poses = samples.values
        return [packet([target], [pose]) for target, pose in zip(targets[:, 0].tolist(), poses.tolist(), strict=True)]


def packet(t_ns: Iterable[int], poses: Any) -> bytes:
    """Return the packet of a plan with times (point,) in UTC ns and poses (point, 7)."""
    points = [[int(at_ns), *(float(number) for number in pose)] for at_ns, pose in zip(t_ns, poses, strict=True)]
    return json.dumps({"version": VERSION, "points": points}).encode()


def is_plan(text: bytes) -> bool:
    """Return whether a packet is a plan: right version, 1 to 1000 points of finite numbers, ascending times."""
    try:
        record = json.loads(text.decode())
        points = record["points"]
        if record["version"] != VERSION or not 0 < len(points) <= MAX_POINTS:
            return False
        times = [point[0] for point in points]
        if not all(type(t_ns) is int and abs(t_ns) < MAX_TIME_NS for t_ns in times):
            return False
        if any(after <= before for before, after in itertools.pairwise(times)):
            return False
        return all(
            len(point) == 1 + NUMBERS
            and all(type(number) in (int, float) and math.isfinite(number) for number in point[1:])
            and any(point[4:])
            for point in points
        )
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError):
        return False
