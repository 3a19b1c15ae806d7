"""Evaluate a touch model and its baselines on unseen grasps."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypedDict

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, Bools, Floats
from tacpipe.channels import biotac_sp
from tacpipe.datasets import selection
from tacpipe.datasets.dataset import Dataset
from tacpipe.errors import TacpipeError
from tacpipe.io import Json, terminal
from tacpipe.plugins.stage import RecordingOutput, Result
from tacpipe.scores import headline, regression, table
from tacpipe.scores.calibration import COVERAGE_FILE
from tacpipe.scores.table import Question, ScoreTable
from tacpipe.tasks.touch import grasps as grasps_of
from tacpipe.tasks.touch import headline as headlines
from tacpipe.tasks.touch import quantiles
from tacpipe.tasks.touch.grasps import Grasps
from tacpipe.tasks.touch.headline import (
    CONSTANT,
    GRASPS,
    MODEL,
    NEAREST_IN_TIME,
    OBJECT_MEAN,
    PREDICTIONS,
    TRUE,
)
from tacpipe.tasks.touch.predictor import CONFIG, HISTORY, Predictor

Readings = Mapping[str, Floats]  # target -> (grasp, value), device counts
Scores = dict[str, float | None]  # values by name; None if a measure is undefined


class ReadingMeasures(TypedDict):
    """The errors of a predictor, by target."""

    rmse: Scores
    rmse_counts: Scores
    rmse_batch_mean: Scores
    mae: Scores
    r2: Scores
    skill: Scores
    skill_low: Scores
    skill_high: Scores
    n: int  # number of grasps


class PredictorMeasures(ReadingMeasures):
    """The errors of a predictor, over all grasps and by object."""

    by_object: dict[str, ReadingMeasures]


class ModelMeasures(PredictorMeasures):
    """The errors of the model itself."""

    by_electrode: dict[str, dict[str, Scores]]  # target -> electrode -> measure -> value


@dataclass(frozen=True)
class TouchScores:
    """The errors of all predictors on a set of grasps."""

    counts: dict[str, int]
    predictors: dict[str, PredictorMeasures] = field(default_factory=dict)

    def to_json(self) -> Json:
        """Return the scores as they are stored in ``metrics.json``."""
        return {"counts": self.counts, **self.predictors}


def reading_measures(
    readings: Readings, predicted: Readings, constant: Readings, clusters: Sequence[str]
) -> ReadingMeasures:
    """Return the errors of one predictor, by measure and target.

    ``rmse`` and ``mae`` are fractions of each target's range (`biotac_sp.RANGES`), pooled over grasps and electrodes.
    ``rmse_counts`` is in device counts. ``rmse_batch_mean`` is the figure of the letter: the mean over batches of ten.
    ``skill`` is 1 - RMSE / RMSE of ``constant``, with a 95 % interval over ``clusters``.
    """
    measures: ReadingMeasures = {
        "rmse": {},
        "rmse_counts": {},
        "rmse_batch_mean": {},
        "mae": {},
        "r2": {},
        "skill": {},
        "skill_low": {},
        "skill_high": {},
        "n": len(clusters),
    }
    for target, values in predicted.items():
        true, model_share, constant_share = (
            biotac_sp.normalise(target, counts[target]) for counts in (readings, predicted, constant)
        )
        measures["rmse"][target] = regression.rmse(true, model_share)
        measures["rmse_counts"][target] = regression.rmse(readings[target], values)
        measures["rmse_batch_mean"][target] = regression.batch_mean_rmse(true, model_share)
        measures["mae"][target] = regression.mae(true, model_share)
        measures["r2"][target] = _finite(regression.r2(true, model_share))
        model, baseline = (regression.squared_sums(true, share) for share in (model_share, constant_share))
        skill, low, high = map(_finite, regression.skill_interval(model, baseline, np.asarray(clusters)))
        measures["skill"][target], measures["skill_low"][target], measures["skill_high"][target] = skill, low, high
    return measures


def by_electrode(readings: Readings, predicted: Readings) -> dict[str, dict[str, Scores]]:
    """Return RMSE (fraction of the range) and R2 of each electrode, by target."""
    by_target = {}
    for target, values in predicted.items():
        if biotac_sp.width(target) > 1:
            true, share = (biotac_sp.normalise(target, counts) for counts in (readings[target], values))
            pairs = zip(regression.rmse_by_value(true, share), regression.r2_by_value(true, share), strict=True)
            by_target[target] = {
                f"{number:02d}": {"rmse": float(rmse), "r2": _finite(float(r2))}
                for number, (rmse, r2) in enumerate(pairs, 1)
            }
    return by_target


def select_rows(predicted: Readings, mask: Bools) -> dict[str, Floats]:
    """Return the values of the grasps selected by a mask (grasp,)."""
    return {target: values[mask] for target, values in predicted.items()}


def _finite(value: float) -> float | None:
    """Return a value for JSON, or None if it is not finite."""
    return value if np.isfinite(value) else None


def evaluate(model: Mapping[str, bytes], recordings: Dataset) -> Result:
    """Return ``metrics.json``, ``by_object.csv`` and each predictor's values for each grasp.

    Errors are computed on unseen grasps, and separately on those of objects with training grasps (``known``) and
    without (``novel``). Training grasps, and grasps whose reading equals that of a training grasp, are reported under
    ``seen``. Raises `TacpipeError` if grasps have no reading or lack inputs of the model.
    """
    predictor = Predictor.load(model)
    with terminal.progress_bar(
        "evaluate", 2 * len(recordings.recordings)
    ) as advance:  # each grasp is read and then predicted
        return _evaluation_result(model, predictor, grasps_of.read(recordings, advance=advance), recordings, advance)


def _evaluation_result(
    model: Mapping[str, bytes], predictor: Predictor, grasps: Grasps, recordings: Dataset, advance: Callable[..., None]
) -> Result:
    """Evaluate a model on grasps, and return the result. ``advance`` updates the progress bar.

    Raises `TacpipeError` if there are no grasps or the model has no baselines.
    """
    if not len(grasps):
        raise TacpipeError(
            "There is no grasp to evaluate the model on. Give a dataset with recordings of the requested role."
        )
    if predictor.baselines is None:
        raise TacpipeError(
            "The model was trained without baselines, and cannot be evaluated. Train it with --baselines."
        )
    predicted = {TRUE: grasps.readings, MODEL: predictor.predict_grasps(grasps), **predictor.baselines.predict(grasps)}
    predicted = {
        name: {target: readings[target] for target in predictor.targets} for name, readings in predicted.items()
    }
    advance(len(grasps))
    streams = {name: readings_table(readings) for name, readings in predicted.items()}
    del predicted[TRUE]
    trained = set(predictor.config["trained_on"].values())
    in_training = np.array(
        [digest in trained for digest in grasps.digests], bool
    ) | predictor.baselines.has_training_reading(grasps)
    is_known = np.array([name in predictor.config["objects"] for name in grasps.objects], bool)
    fresh = _scores(grasps, predicted, ~in_training, is_known)
    masks = {"known": is_known & ~in_training, "novel": ~is_known & ~in_training, "seen": in_training}
    quantile_measures = _quantiles(predictor, grasps, predicted, in_training, is_known)
    tree = {
        **fresh.to_json(),
        **{name: _scores(grasps, predicted, mask, is_known).to_json() for name, mask in masks.items() if mask.any()},
        **({"quantiles": quantile_measures} if quantile_measures else {}),
    }
    files = {
        headline.FILE: headline.write(
            table.headlines(
                headlines.TASK,
                predictor.config["architecture"],
                _tables(predictor, grasps, predicted, in_training, is_known),
            )
        ),
        "metrics.json": (json.dumps(tree, indent=1, sort_keys=True, allow_nan=False) + "\n").encode(),
        "by_object.csv": _object_csv(fresh),
        **{name: model[name] for name in (CONFIG, HISTORY) if name in model},
    }
    if predictor.quantiles is not None:
        files[COVERAGE_FILE] = quantiles.coverage(predictor.quantiles, grasps, predicted, ~in_training, is_known)
    streams[GRASPS] = pa.table(
        {
            "recording": pa.array(grasps.names, pa.string()),
            "object": pa.array(grasps.objects, pa.string()),
            "session": pa.array(grasps.sessions, pa.string()),
            "t_ns": pa.array(grasps.t_ns, pa.int64()),
            "seen": pa.array(in_training, pa.bool_()),
            "known": pa.array(is_known, pa.bool_()),
        }
    )
    attributes = selection.combine_origins(shard.attributes for shard in recordings.recordings.values())
    return Result({PREDICTIONS: RecordingOutput(streams, attributes)}, files)


def _quantiles(
    predictor: Predictor, grasps: Grasps, predicted: Mapping[str, Readings], in_training: Bools, is_known: Bools
) -> Json:
    """Return the quantile measures of a calibrated model on known and on novel objects; empty for other models."""
    if predictor.quantiles is None:
        return {}
    parts = {"known": is_known & ~in_training, "novel": ~is_known & ~in_training}
    clusters = {"known": grasps.names, "novel": grasps.objects}
    measures = {
        name: {
            "n": int(mask.sum()),
            **quantiles.measures_by_predictor(predictor.quantiles, grasps, predicted, mask, clusters[name]),
        }
        for name, mask in parts.items()
        if mask.any()
    }
    return {**predictor.config["quantiles"], **measures}


def _tables(
    predictor: Predictor, grasps: Grasps, predicted: Mapping[str, Readings], in_training: Bools, is_known: Bools
) -> dict[Question, ScoreTable]:
    """Return the table of scores of each target, on known and on novel objects."""
    objects = {name: object_name or "unnamed" for name, object_name in zip(grasps.names, grasps.objects, strict=True)}
    tables = {}
    for known_objects in (True, False):
        rows = np.flatnonzero((is_known == known_objects) & ~in_training)
        names = [grasps.names[row] for row in rows]
        for target in predictor.targets:
            readings = {name: values[target][rows] for name, values in predicted.items()}
            tables[Question(headlines.PARTS[known_objects], headlines.TARGETS[target])] = headlines.score_table(
                target, grasps.readings[target][rows], readings, names, objects, known_objects=known_objects
            )
    return tables


def _scores(grasps: Grasps, predicted: Mapping[str, Readings], mask: Bools, is_known: Bools) -> TouchScores:
    """Return the errors of every predictor on the grasps selected by ``mask`` (grasp,), in total and by object.

    Intervals resample objects if any object is novel, otherwise grasps. ``is_known`` (grasp,) marks known objects.
    """
    if not mask.any():
        return TouchScores({"grasps": 0})
    names, objects = np.array(grasps.names), np.array(grasps.objects)
    clusters = objects if (mask & ~is_known).any() else names
    constant = predicted[CONSTANT]
    predictors: dict[str, PredictorMeasures] = {
        name: {
            **_measures(grasps, readings, constant, mask, clusters),
            "by_object": {
                object_name or "unnamed": _measures(grasps, readings, constant, mask & (objects == object_name), names)
                for object_name in sorted(set(objects[mask]))
            },
        }
        for name, readings in predicted.items()
    }
    readings, model = (select_rows(values, mask) for values in (grasps.readings, predicted[MODEL]))
    own_measures: ModelMeasures = {**predictors[MODEL], "by_electrode": by_electrode(readings, model)}
    predictors[MODEL] = own_measures
    return TouchScores({"grasps": int(mask.sum()), "objects": len(set(objects[mask]))}, predictors)


def _measures(
    grasps: Grasps, predicted: Readings, constant: Readings, mask: Bools, clusters: AnyArray
) -> ReadingMeasures:
    readings, model, mean = (select_rows(values, mask) for values in (grasps.readings, predicted, constant))
    return reading_measures(readings, model, mean, clusters[mask].tolist())


def _object_csv(scores: TouchScores) -> bytes:
    """Return CSV with one row per object, predictor and target: grasps, relative RMSE, RMSE in counts, R2 and skill."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["object", "predictor", "target", "n", "rmse", "rmse_counts", "r2", "skill"])
    for predictor in (MODEL, CONSTANT, OBJECT_MEAN, NEAREST_IN_TIME):
        by_object = scores.predictors[predictor]["by_object"] if predictor in scores.predictors else {}
        for name, measures in by_object.items():
            for target in measures["rmse"]:
                scored = (measures["rmse"], measures["rmse_counts"], measures["r2"], measures["skill"])
                values = [by_target[target] for by_target in scored]
                rounded = ["" if value is None else f"{value:.6g}" for value in values]
                writer.writerow([name, predictor, target, measures["n"], *rounded])
    return text.getvalue().encode()


def simulated(recordings: Dataset) -> dict[str, bool]:
    """Return the attribute that marks results of simulated recordings; empty if all recordings are real."""
    return {selection.SIMULATED: True} if selection.is_simulated(recordings) else {}


def readings_table(predicted: Readings, bands: Mapping[int, Readings] | None = None) -> pa.Table:
    """Return one row per grasp with ``pdc_th``, ``pdc_mf``, ``e_th_01`` … ``e_mf_24`` if predicted, float32, device counts.

    ``bands`` contains quantiles by level in percent. Their columns, such as ``e_th_01_q90``, follow that of the value.
    """
    fields, arrays = [], []
    for target, values in predicted.items():
        for index, (name, column) in enumerate(zip(biotac_sp.value_columns(target), values.T, strict=True)):
            metadata = {"unit": "count", "quantity": "prediction"}
            fields.append(pa.field(name, pa.float32(), metadata=metadata))
            arrays.append(pa.array(column.astype(np.float32)))
            for percent, band in (bands or {}).items():
                level = {**metadata, "quantile": f"{percent / 100:g}"}
                fields.append(pa.field(f"{name}_q{percent}", pa.float32(), metadata=level))
                arrays.append(pa.array(band[target][:, index].astype(np.float32)))
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields))
