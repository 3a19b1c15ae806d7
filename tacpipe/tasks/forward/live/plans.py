"""Read the planned motion of a live session from the set-points of an arm.

A set-point is the pose at which the hand should be now, not later; its recent motion is assumed to continue. It does
not have the noise of measured positions, and is ahead of the hand by the lag of the arm's controller.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import Float32s, Floats
from tacpipe.channels.arm import metres_per_unit
from tacpipe.channels.schema import AXES, COMPONENTS
from tacpipe.errors import UsageError
from tacpipe.models.windows import POSE
from tacpipe.signals import kinematics

if TYPE_CHECKING:
    import pyarrow as pa

POSITION, ORIENTATION = "target_position", "target_orientation"  # quantities
SPAN_NS = 20_000_000  # span over which the set-point's speed is computed
OLD_NS = 50_000_000  # maximum age of the newest set-point; older ones are not used as a plan
AS_OPTIONS = "target_TCP_pose among the outputs of ur-rtde, RSol among those of kuka-rsi, targets = true of franka"


class Targets:
    """The newest set-points in an arm's stream."""

    def __init__(self, stream: str, schema: pa.Schema) -> None:
        """Find the set-points in the stream's schema. Raises `UsageError` if it has no set-points of a pose."""
        self.stream = stream
        fields_by_part = {(_about(field, "quantity"), _about(field, "component")): field for field in schema}
        parts = [*((POSITION, axis) for axis in AXES), *((ORIENTATION, part) for part in COMPONENTS)]
        absent = [f"{quantity} {part}" for quantity, part in parts if (quantity, part) not in fields_by_part]
        if absent:
            raise UsageError(
                f"The stream {stream} has no {absent[0]}: a plan from an arm needs the pose that its controller aims at. "
                f"Record it with the option {AS_OPTIONS}."
            )
        fields = [fields_by_part[part] for part in parts]
        self._names = [field.name for field in fields]
        self._scale = np.array(
            [metres_per_unit(field) if _about(field, "quantity") == POSITION else 1.0 for field in fields]
        )
        self._kept: deque[tuple[int, Floats]] = deque()

    def push(self, batch: Any) -> None:
        """Add samples of the stream in the order of their arrival."""
        names = batch.schema.names
        t_ns = np.asarray(batch.column(names.index("t_ns")))
        poses = np.column_stack([np.asarray(batch.column(names.index(name))) for name in self._names]) * self._scale
        self._kept.extend(zip(t_ns.tolist(), poses, strict=True))

    def state(self, t_ns: int) -> Float32s | None:
        """Return the target pose and velocities (13,) of the controller, or None if its newest set-point is too old.

        The newest set-point up to ``t_ns`` is used, and for velocities also the one `SPAN_NS` before it. Successive
        calls must have ascending times.
        """
        past = [set_point for set_point in self._kept if set_point[0] <= t_ns]
        if not past or t_ns - past[-1][0] > OLD_NS or not np.isfinite(past[-1][1]).all():
            return None
        newest_ns, newest = past[-1]
        before_ns, before = next(
            set_point for set_point in reversed(past) if newest_ns - set_point[0] >= SPAN_NS or set_point is past[0]
        )
        while self._kept and self._kept[0][0] < newest_ns - 2 * SPAN_NS:
            self._kept.popleft()
        sign = 1.0 if newest[3:] @ before[3:] >= 0 else -1.0
        two_poses = np.stack([np.concatenate([before[:3], sign * before[3:]]), newest])
        moved = kinematics.difference_velocity(np.array([before_ns, newest_ns]), two_poses[:, :3], two_poses[:, 3:])[1]
        return np.concatenate([newest, moved]).astype(np.float32)


def facing(state: Float32s, arm: Float32s) -> Float32s:
    """Return a state (13,) with the sign of its quaternion chosen to match that of the arm (13,)."""
    if state[3:POSE] @ arm[3:POSE] >= 0:
        return state
    turned = state.copy()
    turned[3:POSE] *= -1
    return turned


def _about(field: pa.Field, key: str) -> str:
    text: bytes = (field.metadata or {}).get(key.encode(), b"")
    return text.decode()
