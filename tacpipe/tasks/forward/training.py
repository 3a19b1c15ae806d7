"""Train a forecaster from recordings and params, and write the files of its model."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import save as save_arrays
from safetensors.torch import save as save_tensors
from torch import Tensor, nn

from tacpipe.arrays import AnyFloats, Int64s
from tacpipe.channels import streams
from tacpipe.channels.arm import DEFAULT_POSE, Pose
from tacpipe.codecs import codec as codecs
from tacpipe.codecs.codec import INCREMENTS
from tacpipe.datasets import model_files
from tacpipe.datasets.dataset import Dataset
from tacpipe.errors import TacpipeError
from tacpipe.io import terminal
from tacpipe.io.spill import MappedArrays
from tacpipe.models import forecasts
from tacpipe.models.forecasts import Shrunk, persistence_weights
from tacpipe.models.linear import CHUNK, FittedBaselines, WindowArrays
from tacpipe.models.windows import ForecastWindows, motion
from tacpipe.plugins import params as params_of
from tacpipe.tasks.forward import headline, networks, rest_shift, tracks
from tacpipe.tasks.forward.forecaster import (
    BASELINES,
    CONFIG,
    SHRINKAGE,
    TASK,
    WEIGHTS,
    Forecaster,
    largest_level,
    layout,
)
from tacpipe.tasks.forward.headline import look_ahead_notes
from tacpipe.tasks.forward.networks import Rows, WindowLevels, rows_of_tracks, with_actions
from tacpipe.tasks.forward.params import (
    CodecDescription,
    ForwardConfig,
    ForwardScaling,
    LookAhead,
    ModelInputs,
    Params,
)
from tacpipe.tasks.forward.tracks import BLOCK_ROWS, Track
from tacpipe.tasks.recordings import add_earlier, trained_on_datasets
from tacpipe.training import devices, loop, scaling
from tacpipe.training.following import history_bytes

HISTORY = "history.jsonl"
CALIBRATED = 16_384  # evenly spaced windows for fitting scales; they overlap, so almost all rows are used
LINEAR = 20_000  # windows for fitting the linear baselines
SHRINKING = 3000  # maximum number of evenly spaced validation windows for fitting the weights of the forecast


def train(
    params: Params,
    training: Dataset,
    validation: Dataset,
    workspace: Path,
    init: Mapping[str, bytes] | None = None,
) -> dict[str, bytes]:
    """Return the files of a model trained on ``training``, with early stopping by its error on ``validation``.

    Scales and baselines are fitted only on the training recordings, unless scales and weights are taken from the model
    ``init``. The files contain the values that replaced ``auto``. Raises `TacpipeError` if recordings lack columns or
    windows or contain data that the architecture cannot read, and if ``init`` has another shape or codec.
    """
    if not training.recordings:
        raise TacpipeError("There is no training recording. Make a split with `tacpipe split` that has some.")
    first = next(iter(training.recordings.values()))
    schema = first.columns().schema
    codec = tracks.codec_of(schema, training.files, first.name)
    pose = tracks.select_pose(first, params.actions, params.arm)
    unit = headline.unit_of_channels(schema, codec.channels)
    start = Forecaster.load(init) if init else None
    changes = codec.representation == INCREMENTS
    params = params.resolved(layout(codec), start.params if start else None, changes=changes)
    if init and start:
        _check_start(start, init, params, codec, training.files)
        _check_pose(start, pose)
    mapped = MappedArrays(tracks.IN_MEMORY)
    parts = [
        [tracks.track(shard, codec, pose, mapped) for _, shard in sorted(dataset.recordings.items())]
        for dataset in (training, validation)
    ]
    rate_hz = tracks.rate_hz([track for part in parts for track in part])
    if rate_hz:
        terminal.report_progress(f"a step is {1e3 / rate_hz:.4g} ms")
    reference = start.orientation if start else _reference(parts[0])
    parts = [[_align_quaternions(track, reference, mapped) for track in part] for part in parts]
    device = devices.kind()
    training_rows, validation_rows = (
        _windows(part, params, stride, device, mapped) for part, stride in zip(parts, (params.stride, 1), strict=True)
    )
    for role, dataset, windows in (("training", training, training_rows), ("validation", validation, validation_rows)):
        if not len(windows.starts):
            raise tracks.no_window(f"The {role} recordings contain", dataset, params.context, params.horizon)
    _check_channels(codec, parts[0], mapped)
    build = partial(_build_initial, params, codec, training_rows, start, device)
    schedule = loop.Schedule.from_params(params, params.seed, params.gradient_clip)
    trained = loop.train(
        build, loop.WindowTraining(training_rows.part, validation_rows.part, params.batch), schedule, workspace
    )
    weights = trained.weights | _shrinkage(trained.weights, params, codec, validation_rows)
    best = min(trained.history, key=lambda line: line["val_loss"])
    config: ForwardConfig = {
        "task": TASK,
        "architecture": params.architecture,
        "params": params_of.to_json(params),
        "codec": _describe_codec(codec),
        "context": params.context,
        "horizon": params.horizon,
        "inputs": _inputs(codec, pose, unit, reference),
        "rate_hz": rate_hz,
        "gap_ms": _gap_ms(training),
        "timeline": parts[0][0].timeline,
        "scaling": _scaling(parts[0], mapped),
        "largest_level": max(largest_level(track.tactile[usable]) for track, usable in _usable(parts[0], mapped)),
        "validation": {"loss": best["val_loss"], "epoch": best["epoch"]},
        "trained_on": add_earlier(
            trained_on_datasets(training, validation), start.config["trained_on"] if start else {}
        ),
        "objects": sorted({track.object for track in parts[0] if track.object is not None}),
        "counts": {
            name: {"recordings": len(part), "windows": len(rows_of_part.starts)}
            for name, part, rows_of_part in zip(("train", "val"), parts, (training_rows, validation_rows), strict=True)
        },
    }
    if look_ahead := _training_look_ahead(training):
        config["look_ahead"] = look_ahead
    if levels := rest_shift.training_levels(training, codec.channels):
        config["rest_levels"] = levels
    if sessions := rest_shift.sessions([*training.recordings.values(), *validation.recordings.values()]):
        config["sessions"] = sessions
    files = {} if codec.kind == "raw" else {name: training.files[name] for name in (codecs.DESCRIPTION, codecs.TENSORS)}
    if params.baselines:
        recordings = validation_rows.recording_of(validation_rows.evenly_spread(LINEAR)).numpy()
        linear = FittedBaselines.fit(_linear(training_rows), _linear(validation_rows), recordings)
        config["baselines"] = linear.settings
        files[BASELINES] = save_arrays(
            {name: np.ascontiguousarray(array) for name, array in linear.to_tensors().items()}
        )
    return {
        **files,
        WEIGHTS: save_tensors(weights),
        CONFIG: model_files.to_json(config),
        HISTORY: history_bytes(trained.history),
    }


def _build_initial(
    params: Params, codec: codecs.Codec, training_rows: Rows, start: Forecaster | None, device: str
) -> nn.Module:
    """Return the initial network, with scales fitted on some training windows, or with scales and weights of ``start``.

    Raises `TacpipeError` if the architecture cannot predict these windows or ``start`` has other weights.
    """
    model = networks.build(params, codec).to(device)
    if len(training_rows.starts):
        sample = training_rows.pick(training_rows.evenly_spread(CALIBRATED))
        networks.check(model, params, sample[0], len(codec.latents))
        if not start:
            model.calibrate(*sample)  # type: ignore[operator]
    if start:
        _take_over(model, start)
    return model


@torch.no_grad()
def _shrinkage(
    weights: dict[str, Tensor], params: Params, codec: codecs.Codec, validation_rows: Rows
) -> dict[str, Tensor]:
    """Return a tensor with each step's weight of the forecast, fitted on validation windows.

    The result is empty for a model that forecasts levels.
    """
    model = networks.build(params, codec).eval()
    if not model.change_only:
        return {}
    model.load_state_dict(weights)
    starts = validation_rows.evenly_spread(SHRINKING)
    windows, ahead = validation_rows.pick(starts)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(params.seed)  # the seed matters because plans may be shuffled
        windows = ForecastWindows(*(part.cpu() for part in with_actions(windows, validation_rows.actions)))
    ahead, now = ahead.cpu(), windows.touch[-1]
    return {SHRINKAGE: persistence_weights(model(windows) - now, ahead - now, validation_rows.recording_of(starts))}


def _inputs(codec: codecs.Codec, pose: Pose, unit: str, reference: AnyFloats) -> ModelInputs:
    """Return the columns that a model reads and what they mean, for its configuration."""
    inputs: ModelInputs = {
        "tactile": list(codec.channels),
        "layout": [dict(channel) for channel in codec.layout],
        "orientation_reference": reference.tolist(),
        "plan_velocity": tracks.BY_POSES,
    }
    if unit != headline.COUNT:
        inputs["unit"] = unit
    if pose != DEFAULT_POSE:
        inputs["pose"] = {"position": pose.position, "orientation": pose.orientation}
    return inputs


def _training_look_ahead(training: Dataset) -> LookAhead | None:
    """Return how far rows of the training recordings look ahead, or None if no recording contains this information."""
    look_ahead = [
        (
            float(recording.attributes[streams.LOOK_AHEAD_MEAN] or 0),
            float(recording.attributes[streams.LOOK_AHEAD_MAX] or 0),
        )
        for recording in training.recordings.values()
        if streams.LOOK_AHEAD_MAX in recording.attributes
    ]
    if not look_ahead:
        return None
    mean, largest = (np.array(column) for column in zip(*look_ahead, strict=True))
    return {"mean_ms": round(float(mean.mean()), 3), "max_ms": float(largest.max())}


def _gap_ms(training: Dataset) -> dict[str, float]:
    """Return the maximum time between samples without a gap by stream, as the median over recordings that contain it."""
    values: dict[str, list[float]] = {}
    for recording in training.recordings.values():
        for name, value in recording.attributes.items():
            if name.endswith(streams.GAP_MS) and value is not None:
                values.setdefault(name.removesuffix(streams.GAP_MS), []).append(float(value))
    return {stream: float(np.median(gaps_ms)) for stream, gaps_ms in sorted(values.items())}


def check_codec(model: Mapping[str, bytes], recordings: Mapping[str, bytes]) -> None:
    """Raise `TacpipeError` if the recordings' latents come from another codec than the model's."""
    if codecs.TENSORS in model and codecs.TENSORS in recordings and model[codecs.TENSORS] != recordings[codecs.TENSORS]:
        kind = json.loads(model[codecs.DESCRIPTION])["kind"]
        raise TacpipeError(
            "The recordings' latents were made with another codec than the model's, so they mean something else. "
            f"Run `tacpipe compress {kind} --codec` with the latents that the model was trained on."
        )


def _align_quaternions(track: Track, reference: AnyFloats, mapped: MappedArrays) -> Track:
    """Return a track whose quaternions have the sign of ``reference``; negated ones are stored in ``mapped``."""
    arm = tracks.align_quaternions(track.arm, reference)
    return track if arm is track.arm else dataclasses.replace(track, arm=mapped.keep(arm))


def _windows(part: Sequence[Track], params: Params, stride: int, device: str, mapped: MappedArrays) -> Rows:
    """Return the rows of a set of tracks and its windows, either all or those in contact."""
    context, horizon = params.context, params.horizon
    starts = [
        (track.starts if params.windows == "all" else track.contact_starts)(context, horizon, stride) for track in part
    ]
    for track, starts_in_track in zip(part, starts, strict=True):
        track.count_rows(starts_in_track, context + horizon, only_contact=params.windows != "all")
    return rows_of_tracks(part, starts, context, horizon, actions=params.actions, device=device, mapped=mapped)


def _linear(part: Rows) -> WindowArrays:
    """Return past touch (window, context, channel), motion (window, row, 12) and future touch, for the baselines."""
    starts = part.evenly_spread(LINEAR)
    at = starts.cpu().numpy()[:, None]
    past, ahead = at + np.arange(part.context), at + np.arange(part.context, part.context + part.horizon)
    moved = [
        motion(part.pick(starts[first : first + CHUNK])[0])[0].transpose(0, 1).cpu().numpy()
        for first in range(0, len(starts), CHUNK)
    ]
    return WindowLevels(part, past), np.concatenate(moved), WindowLevels(part, ahead)


def _check_channels(codec: codecs.Codec, part: Sequence[Track], mapped: MappedArrays) -> None:
    """Raise `TacpipeError` if no channel of the training recordings ever changes, because there is nothing to predict."""
    if any(track.usable.any() for track in part) and not any(
        track.tactile[usable].any() for track, usable in _usable(part, mapped)
    ):
        raise TacpipeError(
            f"None of the {len(codec.channels)} tactile channels ever moves in {len(part)} training recordings. "
            "Check the sensor, and that the recordings hold contact."
        )


def _scaling(part: Sequence[Track], mapped: MappedArrays) -> ForwardScaling:
    """Return half of each feature's range and each channel's standard deviation over usable training rows.

    Raises `TacpipeError` if there is no usable row.
    """
    ranges = [scaling.fit(track.latent[usable]) for track, usable in _usable(part, mapped)]
    if not ranges:
        scaling.fit(part[0].latent[:0])  # raises an error that explains what to do
    total: AnyFloats = np.zeros(0)
    count = 0
    for track, usable in _usable(part, mapped):
        total = _add_rows(total, track.tactile[usable])
        count += len(usable)
    mean = total / count
    squares: AnyFloats = np.zeros(0)
    for track, usable in _usable(part, mapped):
        squares = _add_rows(squares, (track.tactile[usable] - mean) ** 2)
    spread = np.sqrt(squares / count)
    low = np.min([block_range.low for block_range in ranges], axis=0)
    high = np.max([block_range.high for block_range in ranges], axis=0)
    return {
        "feature_half": scaling.MinMax(low, high).half.tolist(),
        "channel_count": np.where(spread > 0, spread, 1.0).tolist(),
    }


def _usable(part: Sequence[Track], mapped: MappedArrays) -> Iterator[tuple[Track, Int64s]]:
    """Yield each recording with the indices (row,) of its usable rows, in batches."""
    for track in part:
        rows = np.flatnonzero(track.usable)
        for first in range(0, len(rows), BLOCK_ROWS):
            yield track, rows[first : first + BLOCK_ROWS]
            mapped.release()


def _add_rows(total: AnyFloats, rows: AnyFloats) -> AnyFloats:
    """Return ``total`` (channel,) plus rows (row, channel), bit-identical to a single numpy sum."""
    sums: AnyFloats = np.add.reduce(np.concatenate([total[None], rows]) if total.size else rows, axis=0)
    return sums


def _describe_codec(codec: codecs.Codec) -> CodecDescription:
    """Return a codec's description for a model's configuration, including a short name."""
    frames, latents = int(getattr(codec, "frames", 1)), len(codec.latents)
    name = {"raw": "raw", "pca": f"PCA-{latents}", "autoencoder": f"AE-C{frames}-{latents}"}.get(codec.kind, codec.kind)
    if codec.representation != "levels":
        name = f"{name} {codec.representation}"
    return {"kind": codec.kind, "of": codec.representation, "frames": frames, "latents": latents, "name": name}


def _reference(part: Sequence[Track]) -> AnyFloats:
    """Return the first usable quaternion of the training recordings (4,), the reference for the signs of all others."""
    for track in part:
        if track.usable.any():
            return track.arm[track.usable.argmax(), tracks.TURNED].astype(np.float64)
    return np.array([0.0, 0.0, 0.0, 1.0])


def _check_start(
    start: Forecaster,
    init: Mapping[str, bytes],
    params: Params,
    codec: codecs.Codec,
    recordings: Mapping[str, bytes],
) -> None:
    """Raise `TacpipeError` if the initial model does not fit the params or recordings."""
    for name in ("architecture", "members", "hidden", "context", "horizon"):
        started_with, requested = getattr(start.params, name), getattr(params, name)
        if started_with != requested:
            raise TacpipeError(
                f"The model of --init has {name} {started_with} and the one to train {requested}; they must be equal. "
                f"Give --{name} {started_with}, or begin without --init."
            )
    read, recorded = start.config["codec"]["name"], _describe_codec(codec)["name"]
    if read != recorded:
        raise TacpipeError(
            f"The model of --init reads {read} and the recordings hold {recorded}, so its weights mean something else. "
            "Give recordings of the same representation, or begin without --init."
        )
    check_codec(init, recordings)
    codecs.check_channels(start.codec.channels, codec.channels)


def _take_over(model: nn.Module, start: Forecaster) -> None:
    """Copy the initial model's weights into a network. Raises `TacpipeError` if their shapes differ."""
    network = start.model.network if isinstance(start.model, Shrunk) else start.model
    shapes, expected = (
        {name: tuple(weight.shape) for name, weight in module.state_dict().items()} for module in (network, model)
    )
    for name in sorted({*shapes, *expected}):
        if shapes.get(name) != expected.get(name):
            raise TacpipeError(
                f"The weights {name} of the model of --init are {shapes.get(name, 'missing')} and should be "
                f"{expected.get(name, 'missing')}. Train with the params that it was trained with, or begin without --init."
            )
    model.load_state_dict(network.state_dict())


def notes(params: Params, files: Mapping[str, bytes]) -> list[str]:
    """Return notes on a trained model from its ``files``: its look-ahead, and whether another architecture is better."""
    config = json.loads(files[CONFIG])
    rows = look_ahead_notes(config)
    raw, channels = config["codec"]["kind"] == "raw", config["inputs"]["layout"]
    if params.architecture == forecasts.AUTO and raw and config["architecture"] != forecasts.TAXELWISE:
        stated = sum("taxel" in channel for channel in channels)
        reason = (
            f"{stated} of {len(channels)} channels state their taxel"
            if stated < len(channels)
            else "sensors differ in size"
        )
        return [
            *rows,
            f"{reason}, so the architecture is {config['architecture']} and not {forecasts.TAXELWISE}. Write {{taxel}} in "
            f"match of [streams.…] columns of the layout file where channels are taxels.",
        ]
    return rows


def _check_pose(start: Forecaster, pose: Pose) -> None:
    """Raise `TacpipeError` if the initial model reads another arm than the recordings contain."""
    if start.pose != pose:
        read, recorded = (", ".join(pose_read.columns) or "no arm" for pose_read in (start.pose, pose))
        raise TacpipeError(
            f"The model of --init reads {read} and the recordings hold {recorded}. Give recordings of the same arm, or "
            "begin without --init."
        )
