"""Predict future tactile signals with the model, its baselines, and its codec, which limits the model's accuracy."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch

from tacpipe.arrays import AnyFloats, Int64s
from tacpipe.codecs import codec as codecs
from tacpipe.codecs.codec import INCREMENTS
from tacpipe.models.windows import ForecastWindows, motion
from tacpipe.tasks.forward import tracks
from tacpipe.tasks.forward.forecaster import Forecaster
from tacpipe.tasks.forward.headline import BASELINE, MODEL
from tacpipe.tasks.forward.networks import rows_of_tracks
from tacpipe.tasks.forward.tracks import Track

CHUNK = 2048  # windows per batch


@dataclass(frozen=True)
class Prediction:
    """Predictions of one predictor for some windows: features (window, step, feature), counts (window, step, channel).

    Features are those of the model's codec, or None if the predictor has none.
    """

    latent: AnyFloats | None
    count: AnyFloats


@dataclass(frozen=True)
class WindowForecast:
    """Some windows of a recording with only the model's predictions."""

    windows: ForecastWindows
    past: Int64s  # (window, context), input rows
    future: Int64s  # (window, step), predicted rows
    features: AnyFloats  # (window, step, feature)
    count: AnyFloats  # (window, step, channel)

    @property
    def now(self) -> Int64s:
        """Last input row (window,)."""
        return self.past[:, -1]


def forecasts(forecaster: Forecaster, track: Track, starts: Int64s) -> Iterator[WindowForecast]:
    """Yield the model's predictions for the windows of ``track`` that start at ``starts``, in batches."""
    track = replace(track, arm=tracks.align_quaternions(track.arm, forecaster.orientation))
    for first in range(0, len(starts), CHUNK):
        yield _forecast(forecaster, track, starts[first : first + CHUNK])
        track.storage.release()


def _forecast(forecaster: Forecaster, track: Track, starts: Int64s) -> WindowForecast:
    """Return the model's predictions for the windows that start at ``starts``, in order."""
    context, horizon = forecaster.context, forecaster.horizon
    past, future = (starts[:, None] + np.arange(*ends) for ends in ((0, context), (context, context + horizon)))
    block = track.rows_between(int(starts[0]), int(starts[-1]) + context + horizon)
    block_rows = rows_of_tracks([block], [starts - starts[0]], context, horizon)
    windows = block_rows.pick(block_rows.starts)[0]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)  # evaluate a control with the same shuffled plans each time
        features = forecaster.features(windows)
    count = forecaster.decode_counts(features, track.tactile[past[:, -1]], track.latent[past[:, -1]])
    return WindowForecast(windows, past, future, features, count)


@dataclass(frozen=True)
class Predicted:
    """Some windows of a recording with the measured signals and each predictor's predictions."""

    forecaster: Forecaster
    track: Track
    forecast: WindowForecast

    @property
    def truth(self) -> Prediction:
        """The measured signals."""
        return Prediction(self.track.latent[self.forecast.future], self.track.tactile[self.forecast.future])

    def each_prediction(self) -> Iterator[tuple[str, Prediction]]:
        """Yield each predictor's name and prediction, computed one by one, so that not all are in memory at once."""
        forecaster, track, forecast = self.forecaster, self.track, self.forecast
        yield from _model_predictions(forecaster, track, forecast)
        yield from _codec_predictions(forecaster, track, forecast)
        past = track.tactile[forecast.past]
        yield "context_mean", Prediction(None, _repeat_over_steps(past.mean(axis=1), forecaster.horizon))
        if forecaster.baselines is not None:
            moved = motion(forecast.windows)[0].transpose(0, 1).numpy()
            for name, counts in forecaster.baselines.forecasts(past.astype(np.float32), moved):
                yield name, Prediction(None, counts)


def iterate_predictions(forecaster: Forecaster, track: Track, starts: Int64s) -> Iterator[Predicted]:
    """Yield all predictors' predictions for the windows of ``track`` that start at ``starts``, in batches."""
    for forecast in forecasts(forecaster, track, starts):
        yield Predicted(forecaster, track, forecast)
        del forecast  # frees the memory for the next windows


def _model_predictions(
    forecaster: Forecaster, track: Track, forecast: WindowForecast
) -> Iterator[tuple[str, Prediction]]:
    """Yield names and predictions of the model, of persistence, and of the anchored model if the codec loses detail."""
    codec, horizon = forecaster.codec, forecaster.horizon
    last, last_feature = track.tactile[forecast.now], track.latent[forecast.now]
    unchanged = np.zeros_like(last_feature) if codec.representation == INCREMENTS else last_feature
    yield MODEL, Prediction(forecast.features, forecast.count)
    yield BASELINE, Prediction(_repeat_over_steps(unchanged, horizon), _repeat_over_steps(last, horizon))
    if forecaster.lossy and not forecaster.predicts_change:
        yield "model_anchored", Prediction(None, forecaster.anchor_levels(forecast.count, last, last_feature))


def _codec_predictions(
    forecaster: Forecaster, track: Track, forecast: WindowForecast
) -> Iterator[tuple[str, Prediction]]:
    """Yield names and reconstructions of the true future features, whose errors are those of the codec; none if raw."""
    codec = forecaster.codec
    if codec.kind == "raw":
        return
    last, last_feature, ahead = track.tactile[forecast.now], track.latent[forecast.now], track.latent[forecast.future]
    decoded = codecs.decode_ahead(codec, ahead, last)
    yield "codec", Prediction(ahead, decoded)
    if forecaster.lossy:
        yield "codec_persistence", Prediction(None, _repeat_over_steps(codec.decode(last_feature), forecaster.horizon))
        yield "codec_anchored", Prediction(None, forecaster.anchor_levels(decoded, last, last_feature))


def _repeat_over_steps(values: AnyFloats, horizon: int) -> AnyFloats:
    """Return ``values`` (window, channel) repeated for each step, (window, step, channel)."""
    return np.repeat(values[:, None], horizon, axis=1)
