"""Classify the situation of the hand in each window, and sum forecast errors by situation.

Situations depend on a window's last input row and its future rows, so they describe measurements. No model reads them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from tacpipe.arrays import AnyFloats, Int64s
from tacpipe.scores import intervals, regression
from tacpipe.tasks.forward.headline import BASELINE, MODEL
from tacpipe.tasks.forward.metrics import by_step, skill_by_step

if TYPE_CHECKING:  # these modules import torch, which a report does not need
    from tacpipe.tasks.forward.predictors import Prediction
    from tacpipe.tasks.forward.tracks import Track

SITUATIONS = ("no contact", "closing", "releasing", "slipping", "holding in motion", "holding still")
WIDTH_M = 0.0005  # minimum change of the gripper's width that counts as closing or opening
LOST = 0.05  # fraction of the load lost over the future rows when an object slips
PACE_M_S, TURNING_RAD_S = 0.02, 0.1  # minimum speeds of a moving hand


class Motion(NamedTuple):
    """Values (window,) that determine the situation, at the last input row (now) and the last future row (then)."""

    touched_now: AnyFloats  # 1 in contact, else 0
    touched_then: AnyFloats
    load_now: AnyFloats  # mean absolute level over channels
    load_then: AnyFloats
    wider_m: AnyFloats  # increase of the gripper's width
    pace_m_s: AnyFloats  # maximum speed of the hand from now to then
    turning_rad_s: AnyFloats


def situation_numbers(motion: Motion) -> Int64s:
    """Return each window's situation (window,) as an index into `SITUATIONS`, which is the first that applies.

    - no contact: nothing is touched now or then;
    - closing: the gripper's width decreases by more than ``WIDTH_M``, or contact begins;
    - releasing: it increases by more than that, or contact ends;
    - slipping: the load decreases by more than the fraction ``LOST`` while the gripper is still;
    - holding in motion: the hand is faster than ``PACE_M_S`` or ``TURNING_RAD_S``;
    - holding still: all other windows.

    >>> motion = Motion(*(np.array([value]) for value in (1, 1, 100.0, 99.0, 0.0001, 0.3, 0.0)))
    >>> lighter = motion._replace(load_then=np.array([90.0]))
    >>> SITUATIONS[situation_numbers(motion)[0]], SITUATIONS[situation_numbers(lighter)[0]]
    ('holding in motion', 'slipping')
    """
    now, touched_ahead = motion.touched_now > 0, motion.touched_then > 0
    conditions = [
        ~now & ~touched_ahead & (np.abs(motion.wider_m) <= WIDTH_M),
        (motion.wider_m < -WIDTH_M) | (~now & touched_ahead),
        (motion.wider_m > WIDTH_M) | (now & ~touched_ahead),
        motion.load_then < (1 - LOST) * motion.load_now,
        (motion.pace_m_s > PACE_M_S) | (motion.turning_rad_s > TURNING_RAD_S),
    ]
    return np.select(conditions, range(len(conditions)), len(SITUATIONS) - 1).astype(np.int64)


def window_situations(track: Track, now: Int64s, horizon: int) -> Int64s:
    """Return the situation of a recording's windows with the last input rows ``now`` (window,)."""
    if not len(now):
        return np.zeros(0, np.int64)
    end, ahead = now + horizon, now[:, None] + np.arange(horizon + 1)
    speeds = track.arm[ahead][..., 7:].astype(np.float64)  # (window, row, 6)
    return situation_numbers(
        Motion(
            (track.contact[now] >= 0).astype(np.float64),
            (track.contact[end] >= 0).astype(np.float64),
            np.abs(track.tactile[now]).mean(axis=1),
            np.abs(track.tactile[end]).mean(axis=1),
            (track.finger[end] - track.finger[now]).astype(np.float64),
            np.linalg.norm(speeds[..., :3], axis=-1).max(axis=1),
            np.linalg.norm(speeds[..., 3:], axis=-1).max(axis=1),
        )
    )


@dataclass
class BySituation:
    """Error sums by recording, predictor and situation."""

    horizon: int
    channels: int
    windows: dict[str, Int64s] = field(default_factory=dict)  # number of windows by recording, (situation,)
    # (situation, step), by recording and predictor
    absolute: dict[tuple[str, str], AnyFloats] = field(default_factory=dict)

    def count(self, recording: str, situations: Int64s) -> None:
        """Count a recording's windows by situation."""
        counts = np.bincount(situations, minlength=len(SITUATIONS))
        self.windows[recording] = self.windows.get(recording, np.zeros(len(SITUATIONS), np.int64)) + counts

    def add(self, recording: str, situations: Int64s, name: str, predicted: Prediction, truth: Prediction) -> None:
        """Add one predictor's errors on these windows."""
        sums = self.absolute.setdefault((recording, name), np.zeros((len(SITUATIONS), self.horizon)))
        for situation in np.unique(situations):
            chosen = situations == situation
            sums[situation] += regression.absolute_error_sums(predicted.count[chosen], truth.count[chosen]).sum(axis=1)

    def summary(self) -> dict[str, dict[str, Any]]:
        """Return windows, recordings, mean absolute errors by predictor and step, and the model's skill, by situation.

        Skill is 1 minus the geometric mean over recordings of the mean absolute error relative to persistence's, by
        step and over all steps, with an interval over recordings.
        """
        return {name: self._measures(index) for index, name in enumerate(SITUATIONS) if self._recordings(index)}

    def _recordings(self, situation: int) -> list[str]:
        return [name for name, windows in self.windows.items() if windows[situation]]

    def _measures(self, index: int) -> dict[str, Any]:
        """Return the measures of the situation with the index ``index``."""
        recordings = self._recordings(index)
        count = sum(int(self.windows[name][index]) for name in recordings)
        predictors = list(dict.fromkeys(name for _, name in self.absolute))
        errors = {name: self._sums(self.absolute, recordings, name, index).sum(axis=0) for name in predictors}
        model, persistence = (self._sums(self.absolute, recordings, name, index) for name in (MODEL, BASELINE))
        return {
            "windows": count,
            "recordings": len(recordings),
            "mae_counts": {name: by_step(values / (count * self.channels)) for name, values in errors.items()},
            "skill": skill_by_step(intervals.geometric_skill_interval, model, persistence),
        }

    def _sums(self, sums: dict[tuple[str, str], AnyFloats], recordings: Sequence[str], name: str, at: int) -> AnyFloats:
        return np.stack([sums[recording, name][at] for recording in recordings])
