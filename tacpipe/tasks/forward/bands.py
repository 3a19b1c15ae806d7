"""Evaluation of a forecaster's quantiles: how often true values lie in the band, how wide it is, and what it is worth."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyFloats, Float32s, Int64s
from tacpipe.io.parquet import to_parquet
from tacpipe.metrics import quantiles
from tacpipe.metrics.quantiles import Sums
from tacpipe.tasks.forward.forecaster import Forecaster
from tacpipe.tasks.forward.headline import BASELINE, MODEL
from tacpipe.tasks.forward.metrics import Trial
from tacpipe.tasks.forward.predictors import Forecast, forecasts
from tacpipe.tasks.forward.tracks import Track
from tacpipe.tasks.forward.uncertainty import CHUNK, Uncertainty

UNCONDITIONAL = (
    "model_unconditional"  # the model's forecast with constant quantiles of its error on calibration recordings
)
COVERAGE, EXAMPLES = "coverage.parquet", "bands.json"
SHOWN = 2  # recordings whose forecast is drawn with its band
MOST_ROWS = 600  # rows of each
STEP = 10  # ahead, that is drawn; the last one where the model predicts fewer


@dataclass
class Bands:
    """Sums of each predictor's quantiles by recording, and forecasts to draw; empty where a model has no quantiles."""

    forecaster: Forecaster
    sums: dict[str, dict[str, Sums]] = field(default_factory=dict)  # recording -> predictor -> sums
    examples: list[dict[str, Any]] = field(default_factory=list)

    def add(self, track: Track, trial: Trial) -> None:
        """Count the windows of a recording."""
        forecaster = self.forecaster
        uncertainty = forecaster.uncertainty
        if uncertainty is None:
            return
        drawn = _Drawn(forecaster, track) if not trial.seen and len(self.examples) < SHOWN else None
        sums: dict[str, Sums] = {}
        for forecast in forecasts(forecaster, track, track.starts(forecaster.context, forecaster.horizon)):
            for part in _parts(len(forecast.count)):
                truth = track.tactile[forecast.future[part]]
                for name, predicted in _predicted(forecaster, uncertainty, track, forecast, part):
                    flat = predicted.transpose(0, 2, 1, 3).reshape(-1, truth.shape[1], len(uncertainty.percents))
                    true = truth.transpose(0, 2, 1).reshape(-1, truth.shape[1])
                    part_sums = Sums.from_predictions(true, flat, uncertainty.errors.levels)
                    sums[name] = sums[name] + part_sums if name in sums else part_sums
                    if drawn is not None and name == MODEL:
                        drawn.add(forecast.now[part], truth, predicted)
        if sums:
            self.sums[trial.name] = sums
            if drawn is not None:
                self.examples.append(drawn.example(uncertainty.percents))

    def summary(self, trials: Sequence[Trial]) -> dict[str, Any]:
        """Return what ``metrics.json`` holds under ``quantiles``: measures by predictor, of unseen recordings at the top."""
        uncertainty = self.forecaster.uncertainty
        if uncertainty is None:
            return {}
        fresh = [trial for trial in trials if not trial.seen and trial.name in self.sums]
        parts = {
            "known": [trial for trial in fresh if trial.known],
            "unseen": [trial for trial in fresh if not trial.known],
        }
        if not all(parts.values()):
            parts = {}
        parts["seen"] = [trial for trial in trials if trial.seen and trial.name in self.sums]
        described = {"levels": list(uncertainty.percents), **self.forecaster.config.get("quantiles", {})}
        trees = {name: self._tree(part, uncertainty.percents) for name, part in parts.items() if part}
        return {**described, **(self._tree(fresh, uncertainty.percents) if fresh else {}), **trees}

    def _tree(self, trials: Sequence[Trial], percents: tuple[int, ...]) -> dict[str, Any]:
        sums_by_unit: dict[
            str, dict[str, Sums]
        ] = {}  # unit of the interval (recording, or unseen object) to sums by predictor
        for trial in trials:
            sums, unit = self.sums[trial.name], trial.name if trial.known else str(trial.object)
            sums_by_unit[unit] = (
                {name: sums_by_unit[unit][name] + unit_sums for name, unit_sums in sums.items()}
                if unit in sums_by_unit
                else sums
            )
        unit_sums = list(sums_by_unit.values())
        persistence = [sums[BASELINE] for sums in unit_sums]
        return {
            name: quantiles.tree([sums[name] for sums in unit_sums], percents, persistence) for name in unit_sums[0]
        }

    def files(self, trials: Sequence[Trial]) -> dict[str, bytes]:
        """Return ``coverage.parquet``, the sums by recording, predictor and step, and ``bands.json``, forecasts to draw."""
        if self.forecaster.uncertainty is None:
            return {}
        rows: list[dict[str, Any]] = []
        for trial in trials:
            about = {name: getattr(trial, name) for name in ("object", "known", "seen")}
            for predictor, sums in self.sums.get(trial.name, {}).items():
                for at, values in enumerate(sums.values):
                    row = {"recording": trial.name, **about, "predictor": predictor, "step": at + 1, "values": values}
                    row |= {"covered": sums.covered[at], "width": sums.width[at], "pinball": sums.pinball[at].mean()}
                    rows.append(row)
        drawn = (json.dumps(self.examples) + "\n").encode()
        return {COVERAGE: to_parquet(pa.Table.from_pylist(rows, _COLUMNS)), EXAMPLES: drawn}


_COLUMNS = pa.schema(
    {
        **{"recording": pa.string(), "object": pa.string(), "known": pa.bool_(), "seen": pa.bool_()},
        **{"predictor": pa.string(), "step": pa.int32(), "values": pa.float64()},
        **dict.fromkeys(("covered", "width", "pinball"), pa.float64()),
    }
)


def band(forecaster: Forecaster, track: Track, forecast: Forecast, part: slice) -> Float32s:
    """Return the model's quantiles (window, step, channel, level) of some of a forecast's windows.

    The model must have quantiles.
    """
    windows = type(forecast.windows)(*(tensor[:, part] for tensor in forecast.windows))
    return forecaster.band(windows, track.tactile[forecast.past[part]], forecast.count[part])


def _predicted(
    forecaster: Forecaster, uncertainty: Uncertainty, track: Track, forecast: Forecast, part: slice
) -> Iterator[tuple[str, AnyFloats]]:
    """Yield the quantiles (window, step, channel, level) of each predictor."""
    yield MODEL, band(forecaster, track, forecast, part)
    yield UNCONDITIONAL, forecast.count[part][..., None] + uncertainty.unconditional.transpose(2, 1, 0)
    last = track.tactile[forecast.now[part]]
    yield BASELINE, last[:, None, :, None] + uncertainty.persistence.transpose(2, 1, 0)


def _parts(windows: int) -> Iterator[slice]:
    return (slice(first, first + CHUNK) for first in range(0, windows, CHUNK))


class _Drawn:
    """A forecast of the channel of a recording that moves most, with its band."""

    def __init__(self, forecaster: Forecaster, track: Track) -> None:
        self._step = min(STEP, forecaster.horizon)
        self._channel = (
            int(np.argmax(track.tactile[np.flatnonzero(track.usable)].std(axis=0))) if len(track.t_ns) else 0
        )
        self._about = {"recording": track.name, "channel": forecaster.codec.channels[self._channel], "step": self._step}
        self._t_ns, self._rows = track.t_ns, list[tuple[Any, ...]]()

    def add(self, now: Int64s, truth: AnyFloats, predicted: AnyFloats) -> None:
        """Keep the values of some windows."""
        at = (slice(None), self._step - 1, self._channel)
        self._rows += zip(self._t_ns[now + self._step] / 1e9, truth[at], *predicted[at].T, strict=True)

    def example(self, percents: Sequence[int]) -> dict[str, Any]:
        """Return the curves: time in s, what was measured, and each quantile."""
        columns = np.array(self._rows[:MOST_ROWS]).T
        names = ("t_s", "measured", *(f"q{percent}" for percent in percents))
        return {
            **self._about,
            **{name: np.round(values, 4).tolist() for name, values in zip(names, columns, strict=True)},
        }
