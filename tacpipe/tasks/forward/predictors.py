"""All predictors of future tactile signals: the model, its baselines, and the bound that its codec sets."""

from __future__ import annotations

from collections.abc import ItemsView, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch

from tacpipe.arrays import AnyFloats, Int64s
from tacpipe.codecs import codec as codecs
from tacpipe.codecs.frame_stacking import INCREMENTS
from tacpipe.models.windows import Windows, motion
from tacpipe.tasks.forward import tracks
from tacpipe.tasks.forward.forecaster import Forecaster
from tacpipe.tasks.forward.headline import BASELINE, MODEL
from tacpipe.tasks.forward.rows import rows
from tacpipe.tasks.forward.tracks import Track

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
    predictions: Mapping[str, Prediction]  # `items` makes one after another, so that not all are in memory at once


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
    track = replace(track, arm=tracks.aligned(track.arm, forecaster.orientation))
    for first in range(0, len(starts), CHUNK):
        yield _forecast(forecaster, track, starts[first : first + CHUNK])


def _forecast(forecaster: Forecaster, track: Track, some: Int64s) -> Forecast:
    """Return the model's predictions for some windows, those that begin at ``some``, in order."""
    context, horizon = forecaster.context, forecaster.horizon
    past, future = (some[:, None] + np.arange(*ends) for ends in ((0, context), (context, context + horizon)))
    block = track.between(int(some[0]), int(some[-1]) + context + horizon)
    block_rows = rows([block], [some - some[0]], context, horizon)
    windows = block_rows.pick(block_rows.starts)[0]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)  # a control is evaluated with the same shuffled plans each time
        features = forecaster.features(windows)
    count = forecaster.decoded(features, track.tactile[past[:, -1]], track.latent[past[:, -1]])
    return Forecast(windows, past, future, features, count)


def predicted(forecaster: Forecaster, track: Track, starts: Int64s) -> Iterator[Predicted]:
    """Yield what all predictors predict for the windows of ``track`` that begin at ``starts``, some windows at a time."""
    for some in forecasts(forecaster, track, starts):
        truth = Prediction(track.latent[some.future], track.tactile[some.future])
        yield Predicted(some.now, some.features, truth, _Predictions(forecaster, track, some))
        del some, truth  # before the next ones are made


class _Predictions(Mapping[str, Prediction]):
    """The predictions of each predictor for some windows, computed each time that they are asked for."""

    def __init__(self, forecaster: Forecaster, track: Track, some: Forecast) -> None:
        self._forecaster, self._track, self._some = forecaster, track, some

    def items(self) -> ItemsView[str, Prediction]:
        """Return names and predictions, each made when the iteration arrives at it."""
        return _Items(self)

    def __getitem__(self, name: str) -> Prediction:
        for one, prediction in self.made():
            if one == name:
                return prediction
        raise KeyError(name)

    def __iter__(self) -> Iterator[str]:
        return (name for name, _ in self.made())

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def made(self) -> Iterator[tuple[str, Prediction]]:
        """Yield what each predictor predicts."""
        forecaster, track, some = self._forecaster, self._track, self._some
        yield from _of_model(forecaster, track, some)
        yield from _of_codec(forecaster, track, some)
        past = track.tactile[some.past]
        yield "context_mean", Prediction(None, _held(past.mean(axis=1), forecaster.horizon))
        if forecaster.baselines is not None:
            moved = motion(some.windows)[0].transpose(0, 1).numpy()
            past = past.astype(np.float32)
            for name, counts in forecaster.baselines.forecasts(past, moved):
                yield name, Prediction(None, counts)


class _Items(ItemsView[str, Prediction]):
    """Names and predictions of `_Predictions`, without finding each by its name."""

    def __init__(self, predictions: _Predictions) -> None:
        super().__init__(predictions)
        self._made = predictions.made

    def __iter__(self) -> Iterator[tuple[str, Prediction]]:
        return self._made()


def _of_model(forecaster: Forecaster, track: Track, some: Forecast) -> Iterator[tuple[str, Prediction]]:
    """Yield the model's prediction, and persistence."""
    codec, horizon = forecaster.codec, forecaster.horizon
    last, last_feature = track.tactile[some.now], track.latent[some.now]
    still = np.zeros_like(last_feature) if codec.representation == INCREMENTS else last_feature
    yield MODEL, Prediction(some.features, some.count)
    yield BASELINE, Prediction(_held(still, horizon), _held(last, horizon))
    if forecaster.lossy and not forecaster.predicts_change:
        yield "model_anchored", Prediction(None, forecaster.anchored(some.count, last, last_feature))


def _of_codec(forecaster: Forecaster, track: Track, some: Forecast) -> Iterator[tuple[str, Prediction]]:
    """Yield what the codec alone loses of the true features to come."""
    codec = forecaster.codec
    if codec.kind == "raw":
        return
    last, last_feature, ahead = track.tactile[some.now], track.latent[some.now], track.latent[some.future]
    decoded = codecs.decode_ahead(codec, ahead, last)
    yield "codec", Prediction(ahead, decoded)
    if forecaster.lossy:
        yield "codec_persistence", Prediction(None, _held(codec.decode(last_feature), forecaster.horizon))
        yield "codec_anchored", Prediction(None, forecaster.anchored(decoded, last, last_feature))


def _held(values: AnyFloats, horizon: int) -> AnyFloats:
    """Return ``values`` (window, channel) at every step, (window, step, channel)."""
    return np.repeat(values[:, None], horizon, axis=1)
