"""All that say something of the touch to come: the model, and whatever it has to beat or is bounded by."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tacpipe.codecs import codec as codecs
from tacpipe.codecs.stretches import INCREMENTS
from tacpipe.models.windows import motion
from tacpipe.tasks.forward import tracks
from tacpipe.tasks.forward.forecaster import Forecaster
from tacpipe.tasks.forward.rows import rows
from tacpipe.tasks.forward.tracks import Track

Floats = NDArray[np.floating[Any]]

MODEL, BASELINE = "model", "persistence"
CHUNK = 2048  # windows predicted at once


@dataclass(frozen=True)
class Prediction:
    """What one predictor says of some windows: features (window, step, feature), counts (window, step, channel).

    Features are those of the model's codec; None for one that does not speak of them.
    """

    latent: Floats | None
    count: Floats


@dataclass(frozen=True)
class Told:
    """Some windows of a recording: what came, and what each predictor said would come."""

    now: NDArray[np.int64]  # (window,), the last row that is read
    features: Floats  # (window, step, feature) of the model
    truth: Prediction
    predictions: dict[str, Prediction]


def told(forecaster: Forecaster, track: Track, starts: NDArray[np.int64]) -> Iterator[Told]:
    """Yield what all predictors say of the windows of ``track`` that begin at ``starts``, some windows at a time."""
    context, horizon = forecaster.context, forecaster.horizon
    found = rows([track], [starts], context, horizon)
    arm = torch.from_numpy(tracks.aligned(track.arm, forecaster.orientation))
    for first in range(0, len(starts), CHUNK):
        some = starts[first : first + CHUNK]
        past, future = (some[:, None] + np.arange(*ends) for ends in ((0, context), (context, context + horizon)))
        windows = found.pick(torch.from_numpy(some))[0]
        windows = windows._replace(arm=arm[torch.from_numpy(np.hstack([past, future]).T)])
        now = past[:, -1]
        truth = Prediction(track.latent[future], track.tactile[future])
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)  # plans are dealt out alike whenever a control is judged
            features = forecaster.told(windows)
        predictions = _of_model(forecaster, features, track.tactile[now], track.latent[now])
        predictions |= _of_codec(forecaster, track.latent[future], track.tactile[now], track.latent[now])
        predictions["context_mean"] = Prediction(None, _held(track.tactile[past].mean(axis=1), horizon))
        if forecaster.baselines is not None:
            moved = motion(windows)[0].transpose(0, 1).numpy()
            for name, counts in forecaster.baselines.predict(track.tactile[past].astype(np.float32), moved).items():
                predictions[name] = Prediction(None, counts)
        yield Told(now, features, truth, predictions)


def _of_model(forecaster: Forecaster, features: Floats, last: Floats, last_feature: Floats) -> dict[str, Prediction]:
    """Return the model's prediction, and persistence; ``last`` (window, channel) is what is felt now."""
    codec, horizon = forecaster.codec, forecaster.horizon
    still = np.zeros_like(last_feature) if codec.of == INCREMENTS else last_feature
    found = {
        MODEL: Prediction(features, forecaster.decoded(features, last, last_feature)),
        BASELINE: Prediction(_held(still, horizon), _held(last, horizon)),
    }
    if codec.kind != "raw" and codec.of != INCREMENTS and not getattr(forecaster.model, "change_only", False):
        found["model_anchored"] = Prediction(None, forecaster.anchored(codec.decode(features), last, last_feature))
    return found


def _of_codec(forecaster: Forecaster, ahead: Floats, last: Floats, last_feature: Floats) -> dict[str, Prediction]:
    """Return what the codec alone loses of the true features to come, ``ahead`` (window, horizon, feature)."""
    codec = forecaster.codec
    if codec.kind == "raw":
        return {}
    decoded = codecs.decode_ahead(codec, ahead, last)
    found = {"codec": Prediction(ahead, decoded)}
    if codec.of != INCREMENTS:
        found["codec_persistence"] = Prediction(None, _held(codec.decode(last_feature), forecaster.horizon))
        found["codec_anchored"] = Prediction(None, forecaster.anchored(decoded, last, last_feature))
    return found


def _held(values: Floats, horizon: int) -> Floats:
    """Return ``values`` (window, channel) at every step, (window, step, channel)."""
    return np.repeat(values[:, None], horizon, axis=1)
