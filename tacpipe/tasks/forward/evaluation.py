"""Evaluation of a forecaster: on every window of recordings, next to its baselines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Float32s, Int64s
from tacpipe.codecs import codec as codecs
from tacpipe.datasets import model_files
from tacpipe.errors import TacpipeError
from tacpipe.io import progress
from tacpipe.io.spill import Gathered, Spill
from tacpipe.metrics import headline
from tacpipe.plugins.stage import RecordingOutput, Result
from tacpipe.tasks.forward import metrics, situations, tracks, units
from tacpipe.tasks.forward.alarms import Loads
from tacpipe.tasks.forward.bands import Bands
from tacpipe.tasks.forward.forecaster import CONFIG, Forecaster
from tacpipe.tasks.forward.headline import look_ahead_notes
from tacpipe.tasks.forward.metrics import Trial
from tacpipe.tasks.forward.predictors import predicted
from tacpipe.tasks.forward.situations import BySituation
from tacpipe.tasks.forward.slip_alarms import SlipAlarms
from tacpipe.tasks.forward.tracks import Track
from tacpipe.tasks.forward.training import HISTORY, check_codec

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset


KEPT_BYTES = 1 << 24  # size of predictions in memory; larger ones go to disk
STORED_STEPS = (1, 3, 5, 10)  # steps whose predictions are stored; 3, 5 and 10 are those of the paper's figures


def evaluate(model: Mapping[str, bytes], recordings: Dataset) -> Result:
    """Return metrics, tables and predictions of a model, its files given, on ``recordings``, next to its baselines.

    Every window without a gap counts, in contact or not. Errors in counts are against the tactile channels themselves,
    whatever the codec lost. Recordings that the model was trained or stopped on are recognised by their digests and reported
    apart, and so are objects that it was trained on and others. Raises `TacpipeError` where the recordings are not what
    the model reads.
    """
    forecaster = Forecaster.load(model)
    check_codec(model, recordings.files)
    seen_digests, objects = set(forecaster.config["trained_on"].values()), set(forecaster.config["objects"])
    trials, outputs = [], {}
    loads, bands = Loads(forecaster.codec.layout, forecaster.horizon), Bands(forecaster)
    slipping = SlipAlarms.of(forecaster)
    by_situation, spill = BySituation(forecaster.horizon, len(forecaster.codec.channels)), Spill(KEPT_BYTES)
    with progress.bar("evaluate", len(recordings.recordings)) as advance:
        for name, shard in sorted(recordings.recordings.items()):
            track = tracks.track(shard, forecaster.codec, forecaster.pose)
            check_rate(track, forecaster)
            trial = Trial(
                name, shard.digest in seen_digests, track.object, track.object is None or track.object in objects
            )
            attributes = {**shard.attributes, "seen": trial.seen}
            if not trial.seen:
                loads.begin(track)
                slipping.begin(track)
            rows = _predictions(forecaster, track, trial, (loads, slipping), by_situation, spill)
            outputs[name] = RecordingOutput(rows, attributes)
            trials.append(trial)
            bands.add(track, trial)
            del track
            advance(note=name)
    groups = metrics.channel_groups(forecaster.codec.layout)
    tree = metrics.summary(trials, groups, forecaster.horizon, forecaster.channel_scale)
    if warned := loads.scored(forecaster.config.get("anticipation", {})):
        tree["anticipation"] = warned
    if led := slipping.scored():
        tree["slips"] = led
    if situations_tree := by_situation.summary():
        tree["situations"] = situations_tree
    if quantiles := bands.summary(trials):
        tree["quantiles"] = quantiles
    method = f"{forecaster.config['architecture']} · {forecaster.config['codec']['name']}"
    files = {
        headline.FILE: headline.write(
            metrics.headline(method, trials, forecaster.horizon, units.of_model(forecaster.config))
        ),
        "metrics.json": model_files.to_json(tree),
        "horizons.csv": metrics.horizons_csv(tree, forecaster.config["rate_hz"]),
        "trials.csv": metrics.trials_csv(trials),
        "errors.parquet": metrics.errors_parquet(trials, groups, forecaster.channel_scale),
        **bands.files(trials),
        **{name: model[name] for name in (CONFIG, HISTORY, codecs.DESCRIPTION) if name in model},
    }
    return Result(outputs, files, look_ahead_notes(forecaster.config))


def _predictions(
    forecaster: Forecaster,
    track: Track,
    trial: Trial,
    alarms: tuple[Loads, SlipAlarms],
    by_situation: BySituation,
    spill: Spill,
) -> pa.Table | pa.RecordBatchReader:
    """Return the predictions for all windows of a recording, put aside in ``spill``; its errors are added to ``trial``.

    Where the model has not seen it, what alarms look at is added to ``alarms``, which the recording was begun in, and its
    errors by situation to ``by_situation``. Some windows are in memory at a time, and of each one of the predictors.
    """
    loads, slipping = alarms
    starts = track.starts(forecaster.context, forecaster.horizon)
    steps = [step for step in STORED_STEPS if step <= forecaster.horizon]
    none = np.zeros((len(steps), len(forecaster.codec.latents), 0), np.float32)
    gathered = Gathered(spill, _prediction_table(forecaster, track, starts[:0], steps, none))
    for windows in predicted(forecaster, track, starts):
        trial.windows += len(windows.now)
        doing = situations.of_windows(track, windows.now, forecaster.horizon)
        if not trial.seen:
            by_situation.count(trial.name, doing)
        present = track.tactile[windows.now]
        for name, prediction in windows.predictions.items():
            trial.add_errors(name, prediction, windows.truth, forecaster.feature_half)
            if not trial.seen:
                loads.add_one(name, windows.now, prediction)
                slipping.add_one(name, windows.now, present, prediction.count)
                by_situation.add(trial.name, doing, name, prediction, windows.truth)
        stored = windows.features[:, [step - 1 for step in steps]].transpose(1, 2, 0).astype(np.float32)
        gathered.add(_prediction_table(forecaster, track, windows.now, steps, np.ascontiguousarray(stored)))
        del windows, stored  # frees the memory for the next windows
    return gathered.rows()


def _prediction_table(
    forecaster: Forecaster, track: Track, now: Int64s, steps: Sequence[int], stored: Float32s
) -> pa.Table:
    """Return one row a window: the time at which its prediction is available, the features then and those predicted.

    ``now`` (window,) are the last rows that are read; ``stored`` (step, feature, window) becomes the columns without a copy.
    """
    columns = [track.t_ns[now], track.contact[now].astype(np.int32)]
    latent = track.latent[now]
    fields = [
        pa.field("t_ns", pa.int64(), metadata={"quantity": "time", "unit": "ns"}),
        pa.field("contact", pa.int32(), metadata={"quantity": "label"}),
    ]
    for index, name in enumerate(forecaster.codec.latents):
        columns += [latent[:, index], *stored[:, index]]
        for step in (0, *steps):
            about = {"quantity": "latent", "step": str(step)}
            fields.append(pa.field(f"{name}_t{step}" if step else name, pa.float32(), metadata=about))
    arrays = [pa.array(values, field.type) for values, field in zip(columns, fields, strict=True)]
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields))


def check_rate(track: Track, forecaster: Forecaster) -> None:
    """Refuse a track whose grid is not the one the model was trained on."""
    trained, rate_hz = forecaster.config["timeline"], float(forecaster.config["rate_hz"])
    option = f"--rate-hz {rate_hz:g}" if trained == "uniform" else f"--grid {trained}"
    if track.timeline != trained:
        raise TacpipeError(
            f"{track.name} has a {track.timeline} grid and the model was trained on a {trained} one, so a step is "
            f"another time. Synchronize it with {option}."
        )
    track_rate_hz = tracks.rate_hz([track]) if trained == "uniform" else 0.0
    if track_rate_hz and rate_hz and abs(track_rate_hz - rate_hz) > 0.01 * rate_hz:
        raise TacpipeError(
            f"{track.name} has {track_rate_hz:g} rows a second and the model was trained at {rate_hz:g}. "
            f"Synchronize it with {option}."
        )
