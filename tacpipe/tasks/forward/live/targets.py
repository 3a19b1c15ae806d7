"""Where an arm's own controller aims at: set-points in the arm's stream, as the planned motion of a forecast.

A set-point is where the hand is to be now, not later. What it did in the last moments is taken to continue: free of the
noise of measured positions, and ahead of the hand by what it lags behind its controller.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import Float32s, Floats
from tacpipe.channels.pose import metres
from tacpipe.channels.schema import AXES, COMPONENTS
from tacpipe.errors import UsageError
from tacpipe.models.windows import POSE
from tacpipe.signals import kinematics

if TYPE_CHECKING:
    import pyarrow as pa

POSITION, ORIENTATION = "target_position", "target_orientation"  # quantities
SPAN_NS = 20_000_000  # over which the set-point's speed is taken
OLD_NS = 50_000_000  # age of the newest set-point, from which on there is no plan
AS_OPTIONS = "target_TCP_pose among the outputs of ur-rtde, RSol among those of kuka-rsi, targets = true of franka"


class Targets:
    """The newest set-points of one arm's stream."""

    def __init__(self, stream: str, schema: pa.Schema) -> None:
        """Take the stream's schema. Raises `UsageError` where it holds no set-points of a pose."""
        self.stream = stream
        found = {(_about(field, "quantity"), _about(field, "component")): field for field in schema}
        wanted = [*((POSITION, axis) for axis in AXES), *((ORIENTATION, part) for part in COMPONENTS)]
        absent = [f"{quantity} {part}" for quantity, part in wanted if (quantity, part) not in found]
        if absent:
            raise UsageError(
                f"The stream {stream} has no {absent[0]}: a plan from an arm needs the pose that its controller aims at. "
                f"Record it with the option {AS_OPTIONS}."
            )
        fields = [found[one] for one in wanted]
        self._names = [field.name for field in fields]
        self._scale = np.array([metres(field) if _about(field, "quantity") == POSITION else 1.0 for field in fields])
        self._kept: deque[tuple[int, Floats]] = deque()

    def push(self, batch: Any) -> None:
        """Take samples of the stream in the order of their arrival."""
        names = batch.schema.names
        t_ns = np.asarray(batch.column(names.index("t_ns")))
        poses = np.column_stack([np.asarray(batch.column(names.index(name))) for name in self._names]) * self._scale
        self._kept.extend(zip(t_ns.tolist(), poses, strict=True))

    def state(self, t_ns: int) -> Float32s | None:
        """Return pose and velocities (13,) that the controller aims at; None where its newest set-point is too old.

        The newest set-point that is not after ``t_ns`` counts, and for its velocities the one `SPAN_NS` before it. Times
        must not run backwards from one call to the next.
        """
        known = [one for one in self._kept if one[0] <= t_ns]
        if not known or t_ns - known[-1][0] > OLD_NS or not np.isfinite(known[-1][1]).all():
            return None
        newest_ns, newest = known[-1]
        before_ns, before = next(one for one in reversed(known) if newest_ns - one[0] >= SPAN_NS or one is known[0])
        while self._kept and self._kept[0][0] < newest_ns - 2 * SPAN_NS:
            self._kept.popleft()
        sign = 1.0 if newest[3:] @ before[3:] >= 0 else -1.0
        both = np.stack([np.concatenate([before[:3], sign * before[3:]]), newest])
        moved = kinematics.differences(np.array([before_ns, newest_ns]), both[:, :3], both[:, 3:])[1]
        found: Float32s = np.concatenate([newest, moved]).astype(np.float32)
        return found


def facing(state: Float32s, arm: Float32s) -> Float32s:
    """Return a state (13,) whose quaternion has the sign of that of the arm (13,)."""
    if state[3:POSE] @ arm[3:POSE] >= 0:
        return state
    turned = state.copy()
    turned[3:POSE] *= -1
    return turned


def _about(field: pa.Field, key: str) -> str:
    found: bytes = (field.metadata or {}).get(key.encode(), b"")
    return found.decode()
