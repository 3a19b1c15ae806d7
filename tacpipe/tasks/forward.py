"""What will the fingertips feel over the next steps, given the planned motion of the arm?

A window is ``context`` rows t-9 … t of latents and arm state, the arm state of the ``horizon`` rows t+1 … t+10 as the
plan, and the latents of these rows as the answer. The recorded motion stands for the plan, so what is measured holds
for an arm that does as it was told.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor, nn

from tacpipe.codecs import codec as codecs
from tacpipe.errors import TacpipeError
from tacpipe.models.recurrent_forward import RecurrentForward
from tacpipe.stage import Recording, Result
from tacpipe.tasks import scorecard, tracks
from tacpipe.tasks.scorecard import Prediction, Trial
from tacpipe.tasks.tracks import Track
from tacpipe.training import loop, scaling
from tacpipe.training.scaling import MinMax

if TYPE_CHECKING:
    from tacpipe.dataset import Dataset

Floats = NDArray[np.floating[Any]]
Config = dict[str, Any]

TASK = "forward"
CONFIG, WEIGHTS, HISTORY = "config.json", "model.safetensors", "history.jsonl"
TOLD_STEPS = (1, 3, 5, 10)  # whose predictions are stored; 3, 5 and 10 are those of the paper's figures
CHUNK = 4096  # windows predicted at once


@dataclass(frozen=True)
class Forecaster:
    """A trained model with all that it needs to read arrays: scalings, codec and the length of its windows."""

    model: nn.Module
    config: Config
    codec: codecs.Codec
    latent_scale: MinMax
    state_scale: MinMax

    @property
    def context(self) -> int:
        """How many rows of the past the model reads."""
        return int(self.config["context"])

    @property
    def horizon(self) -> int:
        """How many steps ahead it predicts."""
        return int(self.config["horizon"])

    @property
    def orientation(self) -> Floats:
        """The quaternion (4,) whose sign recordings are given."""
        return np.array(self.config["inputs"]["orientation_reference"])

    @classmethod
    def load(cls, files: Mapping[str, bytes]) -> Forecaster:
        """Return the forecaster among a model's files. Raises `TacpipeError` where they are of another task."""
        config: Config = json.loads(files[CONFIG])
        if config["task"] != TASK:
            raise TacpipeError(f"This model was trained for {config['task']}, not for {TASK}.")
        inputs = config["inputs"]
        model = RecurrentForward(len(inputs["latent"]), len(inputs["state"]), config["params"]["hidden"])
        model.load_state_dict(load_tensors(files[WEIGHTS]))
        raw = codecs.Raw(tuple(inputs["tactile"]), tuple(inputs["layout"]))
        codec = raw if config["codec"] == "raw" else codecs.load(files)
        latent, state = (MinMax.from_json(config["scaling"][name]) for name in ("latent", "state"))
        return cls(model.eval(), config, codec, latent, state)

    @torch.no_grad()
    def predict(self, window: Floats, plan: Floats) -> Floats:
        """Return predicted latents (window, horizon, latent), float64, in the codec's unit.

        ``window`` is (window, context, latent + state), latents first, and ``plan`` (window, horizon, state), positions
        in metres and quaternions x, y, z, w. Raises `TacpipeError` for other shapes.
        """
        latents, states = len(self.config["inputs"]["latent"]), len(self.config["inputs"]["state"])
        for name, given, wanted in (
            ("window", window.shape, (self.context, latents + states)),
            ("plan", plan.shape, (self.horizon, states)),
        ):
            if len(given) != 3 or given[1:] != wanted:
                raise TacpipeError(f"The {name} has the shape {given}; this model reads (windows, *{wanted}).")
        past = [self.latent_scale.scale(window[..., :latents]), self.state_scale.scale(window[..., latents:])]
        first = torch.from_numpy(np.concatenate(past, axis=-1)).transpose(0, 1)  # (context, window, latent + state)
        then = torch.from_numpy(self.state_scale.scale(plan)).transpose(0, 1)  # (horizon, window, state)
        predicted = self.model(first.contiguous(), then.contiguous()).transpose(0, 1)
        return self.latent_scale.restore(predicted.numpy())

    def predict_track(self, track: Track, starts: NDArray[np.int64]) -> Floats:
        """Return predicted latents (window, horizon, latent) of the windows of ``track`` that begin at ``starts``."""
        state = tracks.aligned(track.state, self.orientation)
        past, future = _rows(starts, 0, self.context), _rows(starts, self.context, self.horizon)
        return self.predict(np.concatenate([track.latent[past], state[past]], axis=-1), state[future])


def load(files: Mapping[str, bytes]) -> Forecaster:
    """Return the forecaster among a model's files: what `tacpipe.load` gives."""
    return Forecaster.load(files)


def train(
    params: Mapping[str, Any],
    training: Dataset,
    validation: Dataset,
    workspace: Path,
    init: Mapping[str, bytes] | None = None,
) -> dict[str, bytes]:
    """Return the files of a model trained on ``training`` and stopped by its error on ``validation``.

    ``params`` has hidden, context, horizon and what `tacpipe.training.loop.Schedule` has. Scalings are fitted on the
    training recordings alone, or taken over from the model ``init`` with its weights. Raises `TacpipeError` where
    recordings lack columns or windows, and where ``init`` has another shape or codec.
    """
    if not training.shards:
        raise TacpipeError("There is no training recording. Make a split with `tacpipe split` that has some.")
    codec = tracks.codec_of(next(iter(training.shards.values())).table(), training.files)
    parts = {
        "train": [tracks.track(shard, codec) for _, shard in sorted(training.shards.items())],
        "val": [tracks.track(shard, codec) for _, shard in sorted(validation.shards.items())],
    }
    rate_hz = tracks.rate_hz([one for part in parts.values() for one in part])
    start = _start(init, params, training.files) if init else None
    reference = start.orientation if start else _reference([one.state[one.usable, 3:] for one in parts["train"]])
    for name, part in parts.items():
        parts[name] = [dataclasses.replace(one, state=tracks.aligned(one.state, reference)) for one in part]
    latent_scale, state_scale = (start.latent_scale, start.state_scale) if start else _scales(parts["train"])
    context, horizon = params["context"], params["horizon"]
    windows = {name: _windows(part, context, horizon, latent_scale, state_scale) for name, part in parts.items()}
    schedule = loop.Schedule(**{field.name: params[field.name] for field in dataclasses.fields(loop.Schedule)})
    trained = loop.train(
        lambda: start.model if start else RecurrentForward(len(codec.latents), len(tracks.STATE), params["hidden"]),
        windows["train"].part,
        windows["val"].part,
        schedule,
        workspace,
    )
    config: Config = {
        "task": TASK,
        "architecture": "recurrent_forward",
        "params": dict(params),
        "codec": codec.kind,
        "context": context,
        "horizon": horizon,
        "rate_hz": rate_hz,
        "inputs": {
            "latent": list(codec.latents),
            "state": list(tracks.STATE),
            "tactile": list(codec.channels),
            "layout": [dict(one) for one in codec.layout],
            "orientation_reference": reference.tolist(),
        },
        "scaling": {"latent": latent_scale.to_json(), "state": state_scale.to_json()},
        "trained_on": _trained_on((training, validation), start),
        "counts": {name: {"recordings": len(parts[name]), "windows": len(one.starts)} for name, one in windows.items()},
    }
    kept = {} if codec.kind == "raw" else {name: training.files[name] for name in (codecs.DESCRIPTION, codecs.TENSORS)}
    return {
        WEIGHTS: save_tensors(trained.weights),
        CONFIG: (json.dumps(config, indent=1, sort_keys=True) + "\n").encode(),
        HISTORY: trained.history_lines,
        **kept,
    }


def evaluate(model: Mapping[str, bytes], recordings: Dataset) -> Result:
    """Return metrics, tables and predictions of a model, its files given, on ``recordings``, beside its baselines.

    Errors in counts are against the tactile channels themselves, whatever the codec lost. Recordings that the model was
    trained or stopped on are told by their digests and reported apart. Raises `TacpipeError` where the recordings are
    not what the model reads.
    """
    forecaster = Forecaster.load(model)
    _check_codec(model, recordings.files)
    known = set(forecaster.config["trained_on"].values())
    trials, told = [], {}
    for name, shard in sorted(recordings.shards.items()):
        track = tracks.track(shard, forecaster.codec)
        _check_rate(track, forecaster.config["rate_hz"])
        trial = Trial(name, shard.digest in known)
        starts = track.starts(forecaster.context, forecaster.horizon)
        forecast = np.concatenate([_judged(forecaster, track, trial, some) for some in _chunks(starts)])
        attributes = {**shard.attributes, "seen": trial.seen}
        told[name] = Recording(_prediction_table(forecaster, track, starts, forecast), attributes)
        trials.append(trial)
    tree = scorecard.summary(trials, scorecard.channel_groups(forecaster.codec.layout), forecaster.horizon)
    files = {
        "metrics.json": (json.dumps(tree, indent=1, sort_keys=True) + "\n").encode(),
        "horizons.csv": scorecard.horizons_csv(tree, forecaster.config["rate_hz"]),
        "trials.csv": scorecard.trials_csv(trials),
        **{name: model[name] for name in (CONFIG, HISTORY) if name in model},
    }
    return Result(told, files)


@dataclass(frozen=True)
class _Windows:
    """Scaled rows of all recordings one after the other, and where windows start."""

    rows: Tensor  # (time, latent + state)
    starts: Tensor  # (window,)
    latents: int
    context: int
    horizon: int

    @property
    def part(self) -> loop.Part:
        """What the training loop reads."""
        return loop.Part(len(self.starts), self.loss)

    def loss(self, model: nn.Module, indices: Tensor) -> Tensor:
        """Return the mean squared error over steps and latents of the windows with these indices."""
        rows = torch.arange(self.context + self.horizon)[:, None] + self.starts[indices]  # (step, window)
        picked = self.rows.index_select(0, rows.flatten()).view(*rows.shape, -1)  # (step, window, latent + state)
        past, future = picked[: self.context], picked[self.context :]
        predicted = model(past, future[..., self.latents :])
        return nn.functional.mse_loss(predicted, future[..., : self.latents])


def _windows(part: Sequence[Track], context: int, horizon: int, latent: MinMax, state: MinMax) -> _Windows:
    """Return the windows of all tracks of a part, scaled."""
    scaled = [np.hstack([latent.scale(one.latent), state.scale(one.state)]) for one in part]
    offsets = np.cumsum([0] + [len(one) for one in scaled])
    starts = [one.starts(context, horizon) + offset for one, offset in zip(part, offsets, strict=False)]
    width = len(latent.low) + len(state.low)
    rows = np.concatenate([np.zeros((0, width), np.float32), *scaled])
    return _Windows(
        torch.from_numpy(rows),
        torch.from_numpy(np.concatenate([np.zeros(0, np.int64), *starts])),
        len(latent.low),
        context,
        horizon,
    )


def _reference(quaternions: Sequence[Floats]) -> Floats:
    """Return the first usable quaternion of the training recordings (4,): the sign that all are given."""
    return next((one[0].astype(np.float64) for one in quaternions if len(one)), np.array([0.0, 0.0, 0.0, 1.0]))


def _rows(starts: NDArray[np.int64], first: int, count: int) -> NDArray[np.int64]:
    """Return the rows (window, count) that begin ``first`` after each start."""
    return starts[:, None] + np.arange(first, first + count)


def _chunks(starts: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Yield the starts in pieces; one empty piece where there are none."""
    for index in range(0, max(len(starts), 1), CHUNK):
        yield starts[index : index + CHUNK]


def _judged(forecaster: Forecaster, track: Track, trial: Trial, starts: NDArray[np.int64]) -> Floats:
    """Return the predicted latents (window, horizon, latent) of some windows, and add all predictors' errors."""
    context, horizon, decode = forecaster.context, forecaster.horizon, forecaster.codec.decode
    forecast = forecaster.predict_track(track, starts)
    if not len(starts):
        return forecast
    past, future = _rows(starts, 0, context), _rows(starts, context, horizon)
    last = np.repeat(past[:, -1:], horizon, axis=1)  # (window, step)
    truth = Prediction(track.latent[future], track.tactile[future])
    mean = Prediction(*(_held(values[past].mean(axis=1), horizon) for values in (track.latent, track.tactile)))
    predictions = {
        scorecard.MODEL: Prediction(forecast, decode(forecast)),
        scorecard.BASELINE: Prediction(track.latent[last], track.tactile[last]),
        "context_mean": mean,
    }
    if forecaster.codec.kind != "raw":
        predictions["codec_persistence"] = Prediction(track.latent[last], decode(track.latent[last]))
        predictions["codec"] = Prediction(truth.latent, decode(truth.latent))
    trial.add(predictions, truth, forecaster.latent_scale.half)
    return forecast


def _held(values: Floats, horizon: int) -> Floats:
    """Return ``values`` (window, channel) at every step, (window, step, channel)."""
    return np.repeat(values[:, None], horizon, axis=1)


def _prediction_table(forecaster: Forecaster, track: Track, starts: NDArray[np.int64], forecast: Floats) -> pa.Table:
    """Return one row a window: the time at which its prediction is available, the latents then and those predicted."""
    now = starts + forecaster.context - 1
    columns = [track.t_ns[now], track.contact[now].astype(np.int32)]
    fields = [
        pa.field("t_ns", pa.int64(), metadata={"quantity": "time", "unit": "ns"}),
        pa.field("contact", pa.int32(), metadata={"quantity": "label"}),
    ]
    steps = [0, *(step for step in TOLD_STEPS if step <= forecaster.horizon)]
    for index, name in enumerate(forecaster.codec.latents):
        for step in steps:
            columns.append(forecast[:, step - 1, index].astype(np.float32) if step else track.latent[now, index])
            about = {"quantity": "latent", "step": str(step)}
            fields.append(pa.field(f"{name}_t{step}" if step else name, pa.float32(), metadata=about))
    arrays = [pa.array(values, field.type) for values, field in zip(columns, fields, strict=True)]
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields))


def _scales(part: list[Track]) -> tuple[MinMax, MinMax]:
    """Return the scalings of latents and states, fitted on usable rows."""
    latent, state = ([getattr(one, name)[one.usable] for one in part] for name in ("latent", "state"))
    return scaling.fit(np.concatenate(latent)), scaling.fit(np.concatenate(state))


def _trained_on(parts: tuple[Dataset, ...], start: Forecaster | None) -> dict[str, str]:
    """Return the digests of all recordings that the model has seen by name, those of the one it began with included."""
    digests = {shard.name: shard.digest for part in parts for shard in part.shards.values()}
    before = (
        {f"{name} of the model before": digest for name, digest in start.config["trained_on"].items()} if start else {}
    )
    return {**{name: digest for name, digest in before.items() if digest not in digests.values()}, **digests}


def _start(init: Mapping[str, bytes], params: Mapping[str, Any], recordings: Mapping[str, bytes]) -> Forecaster:
    """Return the model to begin with. Raises `TacpipeError` where it does not fit what is to be trained."""
    start = Forecaster.load(init)
    for name in ("hidden", "context", "horizon"):
        found = start.config["params"][name]
        if found != params[name]:
            raise TacpipeError(
                f"The model of --init has {name} {found} and the one to train {params[name]}; they must be equal. "
                f"Give --{name} {found}, or begin without --init."
            )
    _check_codec(init, recordings)
    return start


def _check_codec(model: Mapping[str, bytes], recordings: Mapping[str, bytes]) -> None:
    """Refuse latents that another codec made than the model's."""
    if codecs.TENSORS in model and codecs.TENSORS in recordings and model[codecs.TENSORS] != recordings[codecs.TENSORS]:
        raise TacpipeError(
            "The recordings' latents were made with another codec than the model's, so they mean something else. "
            "Run `tacpipe compress pca --codec` with the latents that the model was trained on."
        )


def _check_rate(track: Track, rate_hz: float) -> None:
    """Refuse a track whose grid has another rate than the one the model was trained at."""
    found = 0.0 if track.logged else tracks.rate_hz([track])
    if found and rate_hz and abs(found - rate_hz) > 0.01 * rate_hz:
        raise TacpipeError(
            f"{track.name} has {found:g} rows a second and the model was trained at {rate_hz:g}. "
            f"Synchronize it with --rate-hz {rate_hz:g}."
        )
