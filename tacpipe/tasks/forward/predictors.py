"""All predictors of future tactile signals: the model, its baselines, and the bound that its codec sets."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch

from tacpipe.arrays import AnyFloats, Int64s
from tacpipe.codecs import codec as codecs
from tacpipe.codecs.frame_stacking import INCREMENTS
from tacpipe.models.windows import Windows, motion
from tacpipe.tasks.forward import tracks
from tacpipe.tasks.forward.forecaster import Forecaster
from tacpipe.tasks.forward.rows import rows
from tacpipe.tasks.forward.tracks import Track

MODEL, BASELINE = "model", "persistence"
CHUNK = 2048  # windows predicted at once


@dataclass(frozen=True)
class Prediction:
    """The predictions of one predictor for some windows: features (window, step, feature), counts (window, step, channel).

    Features are those of the model's codec; None for a predictor that has none.
    """

    latent: AnyFloats | None
    count: AnyFloats


@dataclass(frozen=True)
class Predicted:
    """Some windows of a recording: the measured signals, and the predictions of each predictor."""

    now: Int64s  # (window,), the last row that is read
    features: AnyFloats  # (window, step, feature) of the model
    truth: Prediction
    predictions: dict[str, Prediction]


@dataclass(frozen=True)
class Forecast:
    """Some windows of a recording, and the predictions of the model alone."""

    windows: Windows
    past: Int64s  # (window, context), rows that are read
    future: Int64s  # (window, step), rows that are predicted
    features: AnyFloats  # (window, step, feature)
    count: AnyFloats  # (window, step, channel)

    @property
    def now(self) -> Int64s:
        """The last row that is read (window,)."""
        return self.past[:, -1]


def forecasts(forecaster: Forecaster, track: Track, starts: Int64s) -> Iterator[Forecast]:
    """Yield the model's predictions for the windows of ``track`` that begin at ``starts``, some windows at a time."""
    context, horizon = forecaster.context, forecaster.horizon
    track = replace(track, arm=tracks.aligned(track.arm, forecaster.orientation))
    found = rows([track], [starts], context, horizon)
    for first in range(0, len(starts), CHUNK):
        some = starts[first : first + CHUNK]
        past, future = (some[:, None] + np.arange(*ends) for ends in ((0, context), (context, context + horizon)))
        windows = found.pick(torch.from_numpy(some))[0]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)  # a control is evaluated with the same shuffled plans each time
            features = forecaster.features(windows)
        count = forecaster.decoded(features, track.tactile[past[:, -1]], track.latent[past[:, -1]])
        yield Forecast(windows, past, future, features, count)


def predicted(forecaster: Forecaster, track: Track, starts: Int64s) -> Iterator[Predicted]:
    """Yield what all predictors predict for the windows of ``track`` that begin at ``starts``, some windows at a time."""
    for some in forecasts(forecaster, track, starts):
        last, last_feature = track.tactile[some.now], track.latent[some.now]
        truth = Prediction(track.latent[some.future], track.tactile[some.future])
        predictions = _of_model(forecaster, some, last, last_feature)
        predictions |= _of_codec(forecaster, track.latent[some.future], last, last_feature)
        past = track.tactile[some.past]
        predictions["context_mean"] = Prediction(None, _held(past.mean(axis=1), forecaster.horizon))
        if forecaster.baselines is not None:
            moved = motion(some.windows)[0].transpose(0, 1).numpy()
            for name, counts in forecaster.baselines.predict(past.astype(np.float32), moved).items():
                predictions[name] = Prediction(None, counts)
        yield Predicted(some.now, some.features, truth, predictions)


def _of_model(
    forecaster: Forecaster, some: Forecast, last: AnyFloats, last_feature: AnyFloats
) -> dict[str, Prediction]:
    """Return the model's prediction, and persistence; ``last`` (window, channel) is the last row that is read."""
    codec, horizon = forecaster.codec, forecaster.horizon
    still = np.zeros_like(last_feature) if codec.representation == INCREMENTS else last_feature
    found = {
        MODEL: Prediction(some.features, some.count),
        BASELINE: Prediction(_held(still, horizon), _held(last, horizon)),
    }
    if forecaster.lossy and not forecaster.predicts_change:
        found["model_anchored"] = Prediction(None, forecaster.anchored(some.count, last, last_feature))
    return found


def _of_codec(
    forecaster: Forecaster, ahead: AnyFloats, last: AnyFloats, last_feature: AnyFloats
) -> dict[str, Prediction]:
    """Return what the codec alone loses of the true features to come, ``ahead`` (window, horizon, feature)."""
    codec = forecaster.codec
    if codec.kind == "raw":
        return {}
    decoded = codecs.decode_ahead(codec, ahead, last)
    found = {"codec": Prediction(ahead, decoded)}
    if forecaster.lossy:
        found["codec_persistence"] = Prediction(None, _held(codec.decode(last_feature), forecaster.horizon))
        found["codec_anchored"] = Prediction(None, forecaster.anchored(decoded, last, last_feature))
    return found


def _held(values: AnyFloats, horizon: int) -> AnyFloats:
    """Return ``values`` (window, channel) at every step, (window, step, channel)."""
    return np.repeat(values[:, None], horizon, axis=1)
