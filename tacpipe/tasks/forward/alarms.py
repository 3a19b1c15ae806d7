"""Measure whether predictors warn of a change of load before it begins."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field

import numpy as np

from tacpipe.arrays import AnyFloats, Int64s
from tacpipe.signals import holds
from tacpipe.tasks.forward import anticipation
from tacpipe.tasks.forward.headline import BASELINE, MODEL
from tacpipe.tasks.forward.loads import loads
from tacpipe.tasks.forward.params import AlarmLevels
from tacpipe.tasks.forward.predictors import Predicted, Prediction
from tacpipe.tasks.forward.tracks import Track

Layout = Sequence[Mapping[str, str]]

WATCHED = (MODEL, BASELINE, "damped_trend", "last_value_linear", "ridge", "ridge_actions")


@dataclass
class Loads:
    """The mean count of each sensor's axes on all rows, and its predictions at the last step of the horizon."""

    layout: Layout
    horizon: int
    truth: list[AnyFloats] = field(default_factory=list)  # (time, feature) each
    groups: list[Int64s] = field(default_factory=list)
    ahead: dict[str, list[AnyFloats]] = field(default_factory=dict)
    steps_s: list[float] = field(default_factory=list)

    def begin(self, track: Track) -> None:
        """Add the rows of a recording, without predictions yet."""
        truth = loads(track.tactile, self.layout)
        offset = max((int(groups[-1]) + 1 for groups in self.groups if len(groups)), default=0)
        self.truth.append(np.where(track.usable[:, None], truth, np.nan))
        self.groups.append(track.groups + offset)
        if len(track.t_ns) > 1:
            self.steps_s.append(float(np.median(np.diff(track.t_ns))) / 1e9)
        for name in WATCHED:
            self.ahead.setdefault(name, []).append(np.full_like(truth, np.nan))

    def add(self, windows: Predicted) -> None:
        """Add the predictions for some windows of the recording that was begun last."""
        for name, prediction in windows.predictions.items():
            self.add_one(name, windows.now, prediction)

    def add_one(self, name: str, now: Int64s, prediction: Prediction) -> None:
        """Add the predictions of one predictor for windows whose last rows are ``now``, as `add` does."""
        if name in WATCHED:
            self.ahead[name][-1][now] = loads(prediction.count[:, -1], self.layout)

    def calibrated(self) -> AlarmLevels:
        """Return each load's usual change and, by predictor, the alarm levels that give a false alarm a minute."""
        if not self.truth:
            return {}
        truth, groups = np.concatenate(self.truth), np.concatenate(self.groups)
        sd = anticipation.difference_sd(truth, groups, horizon=self.horizon)
        theta = {
            name: anticipation.calibrate(
                truth, ahead, groups, horizon=self.horizon, sd=sd, rate_hz=self.rate_hz
            ).tolist()
            for name, ahead in self._with_forecasts()
        }
        # JSON holds no infinity: null stands in its place
        levels = {name: [value if math.isfinite(value) else None for value in values] for name, values in theta.items()}
        return {"sd": sd.tolist(), "theta": levels}

    def scored(self, levels: AlarmLevels) -> dict[str, dict[str, float | int | None]]:
        """Return how well each predictor predicted changes with the ``levels`` that `calibrated` gave."""
        if not levels or not self.truth:
            return {}
        truth, groups, sd = np.concatenate(self.truth), np.concatenate(self.groups), np.array(levels["sd"])
        scores = {}
        for name, ahead in self._with_forecasts():
            if name not in levels["theta"]:
                continue
            theta = np.array([math.inf if value is None else value for value in levels["theta"][name]])
            score = anticipation.score(
                truth,
                ahead,
                groups,
                horizon=self.horizon,
                sd=sd,
                theta=theta,
                rate_hz=self.rate_hz,
                repeated=holds.held(truth),
            )
            scores[name] = {key: _number(value) for key, value in asdict(score).items()}
        return scores

    def _with_forecasts(self) -> list[tuple[str, AnyFloats]]:
        joined = {name: np.concatenate(parts) for name, parts in self.ahead.items()}
        return [(name, values) for name, values in joined.items() if np.isfinite(values).any()]

    @property
    def rate_hz(self) -> float:
        """Rows a second; 1 where no recording has two."""
        return 1 / float(np.median(self.steps_s)) if self.steps_s else 1.0


def _number(value: float | int) -> float | int | None:
    """Return ``value`` to 9 digits, None where it is not finite."""
    if isinstance(value, int):
        return value
    return float(f"{value:.9g}") if math.isfinite(value) else None
