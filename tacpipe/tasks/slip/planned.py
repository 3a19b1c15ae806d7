"""Read the planned motion of the hand ahead of a row, and compute features of it.

A plan is used from its arrival on, and only as it was sent, so a row never depends on values that are measured later. The
plan is sampled at the row and at `POINTS` times after it. Accelerations are differences of the planned positions.
"""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyFloats, Floats, Times
from tacpipe.datasets.dataset import Recording
from tacpipe.live.decoding import BatchColumns
from tacpipe.live.plans import PlanHistory, PosePlan
from tacpipe.plugins.rows import RowCounts, count_rows
from tacpipe.sensors.plan import NAME as PLAN
from tacpipe.tasks.learning.features import EPSILON, NAMES

STEP_NS, POINTS = 20_000_000, 50  # times after a row at which a plan is sampled: one second
SMALLEST_STEP_NS = 10_000_000  # time between two points of a plan below which the later one is left out
GRAVITY_M_S2 = 9.81
# channels of a sampled plan: |a + g| / g with z upwards, |a| / g, and the speed in m/s
CHANNELS = ("load", "acceleration", "speed")
SPANS_S = (0.1, 0.2, 0.5, 1.0)  # times after a row up to which the largest value is a feature

NAMES_OF_PLAN = (
    *("planned load", "planned acceleration", "planned speed", "largest planned speed", "time to largest planned load"),
    *(f"largest planned load {span:g} s" for span in SPANS_S),
    *(f"largest planned acceleration {span:g} s" for span in SPANS_S),
    *(f"rise of planned load {span:g} s" for span in SPANS_S),
)
RATIOS = ("shear over load", "taxel ratio")  # features of touch that rise with the load
NAMES_WITH_TOUCH = tuple(f"predicted {name} {span:g} s" for name in RATIOS for span in SPANS_S)


class PlannedMotion:
    """The plans of a recording or of a session, sampled ahead of rows."""

    def __init__(self) -> None:
        self._history = PlanHistory()
        self._motions: dict[int, tuple[Times, Floats]] = {}  # arrival -> times and motion of its plan

    @classmethod
    def from_recording(cls, recording: Recording) -> PlannedMotion | None:
        """Return the plans in the stream ``plan`` of a recording, or None if it has no such stream."""
        if PLAN not in recording.streams:
            return None
        plans = cls()
        plans.push(table := recording.table(PLAN))
        count_rows(recording.name, PLAN, RowCounts.all_used(table.num_rows))
        return plans

    def push(self, batch: pa.Table | BatchColumns) -> Times:
        """Add rows of the stream of plans in the order of their arrival, and return the arrivals of their plans."""
        arrivals = self._history.push(batch)
        for arrived_ns in arrivals.tolist():
            self._motions.pop(arrived_ns, None)
        return arrivals

    def forget_before(self, t_ns: int) -> None:
        """Drop the plans that a newer plan had replaced at a time."""
        self._history.forget_before(t_ns)
        active = self._history.arrival(t_ns)
        self._motions = {arrived_ns: motion for arrived_ns, motion in self._motions.items() if arrived_ns == active}

    def ahead(self, t_ns: int) -> Floats:
        """Return the motion that is planned at a time and after it (point, channel); NaN where no plan covers it."""
        arrived_ns = self._history.arrival(t_ns)
        if arrived_ns is None:
            return np.full((1 + POINTS, len(CHANNELS)), np.nan)
        if arrived_ns not in self._motions:
            plan = self._history.newest(t_ns)
            assert plan is not None
            self._motions[arrived_ns] = motion(plan)
        return sample(*self._motions[arrived_ns], t_ns)


def motion(plan: PosePlan) -> tuple[Times, Floats]:
    """Return times (point,) and velocity and acceleration (point, 6) of a plan, in m/s and m/s².

    >>> from tacpipe.live.plans import PosePlan
    >>> x = np.array([0.0, 0.1, 0.4, 0.9])  # m, each second
    >>> poses = np.column_stack([x, np.zeros((4, 6))])
    >>> motion(PosePlan(np.arange(4) * 10**9, poses))[1][:, [0, 3]].round(6).tolist()
    [[0.1, 0.2], [0.2, 0.2], [0.4, 0.2], [0.5, 0.2]]
    """
    t_ns, position = _thinned(plan)
    if len(t_ns) < 2:
        return t_ns, np.zeros((len(t_ns), 6))
    step_s = np.diff(t_ns)[:, None] / 1e9
    between = np.diff(position, axis=0) / step_s  # (point - 1, 3)
    pair_s = step_s[:-1] + step_s[1:]
    velocity = (between[:-1] * step_s[1:] + between[1:] * step_s[:-1]) / pair_s
    acceleration = 2 * np.diff(between, axis=0) / pair_s
    if len(acceleration):
        acceleration = np.concatenate([acceleration[:1], acceleration, acceleration[-1:]])
    else:
        acceleration = np.zeros((2, 3))
    return t_ns, np.hstack([np.concatenate([between[:1], velocity, between[-1:]]), acceleration])


def _thinned(plan: PosePlan) -> tuple[Times, Floats]:
    """Return times (point,) and positions (point, 3) of a plan without points that follow closely."""
    kept, last_ns = [], -SMALLEST_STEP_NS
    for index, t_ns in enumerate((plan.t_ns - plan.t_ns[0]).tolist()):
        if t_ns - last_ns >= SMALLEST_STEP_NS:
            kept.append(index)
            last_ns = t_ns
    return plan.t_ns[kept], plan.poses[kept, :3]


def sample(t_ns: Times, moved: Floats, at_ns: int) -> Floats:
    """Return the channels (point, channel) of a motion (point, 6) at a time and at `POINTS` times after it."""
    after_ns = np.arange(1 + POINTS) * STEP_NS
    since_ns = t_ns - at_ns
    values = [np.interp(after_ns, since_ns, column, np.nan, np.nan) for column in moved.T]
    x, y, z = values[3:]
    level = np.square(x) + np.square(y)
    load = np.sqrt(level + np.square(z + GRAVITY_M_S2)) / GRAVITY_M_S2
    acceleration = np.sqrt(level + np.square(z)) / GRAVITY_M_S2
    speed = np.sqrt(np.square(values[0]) + np.square(values[1]) + np.square(values[2]))
    return np.stack([load, acceleration, speed], axis=1)


def planned_features(ahead: AnyFloats) -> Floats:
    """Return the features (window, feature) of planned motion (window, point, channel), as `NAMES_OF_PLAN`."""
    load, acceleration, speed = (ahead[:, :, index] for index in range(len(CHANNELS)))
    tops = np.where(np.isnan(load), -np.inf, load).argmax(axis=1)
    time_s = np.where(np.isnan(load).all(axis=1), np.nan, tops * (STEP_NS / 1e9))
    loads, accelerations = (_largest(values) for values in (load, acceleration))
    rises = [largest / np.maximum(load[:, 0], EPSILON) for largest in loads]
    return np.stack(
        [load[:, 0], acceleration[:, 0], speed[:, 0], _largest(speed)[-1], time_s, *loads, *accelerations, *rises],
        axis=1,
    )


def _largest(values: AnyFloats) -> list[Floats]:
    """Return the largest value (window,) up to each of `SPANS_S` after the row, of values (window, point)."""
    return [np.fmax.reduce(values[:, : 1 + round(span * 1e9) // STEP_NS], axis=1) for span in SPANS_S]


def predicted_ratios(touch: Floats, planned: Floats) -> Floats:
    """Return shear over load (window, feature) as it will be if the object sticks, as `NAMES_WITH_TOUCH`.

    ``touch`` (window, feature) are the features of touch, of which the first are those of one finger or the largest of
    all fingers. ``planned`` (window, feature) are those of the plan.
    """
    rises = planned[:, [NAMES_OF_PLAN.index(f"rise of planned load {span:g} s") for span in SPANS_S]]
    return np.concatenate([touch[:, [NAMES.index(name)]] * rises for name in RATIOS], axis=1)


def sample_ahead(plans: PlannedMotion | None, t_ns: Times) -> Floats:
    """Return the planned motion ahead of times (time, point, channel); NaN without plans."""
    if plans is None:
        return np.full((len(t_ns), 1 + POINTS, len(CHANNELS)), np.nan)
    return np.array([plans.ahead(at_ns) for at_ns in t_ns.tolist()]).reshape(-1, 1 + POINTS, len(CHANNELS))
