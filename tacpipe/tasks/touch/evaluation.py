"""Evaluate a touch model and its baselines on unseen grasps."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray
from tacpipe.channels import biotac_sp
from tacpipe.datasets import model_files, selection
from tacpipe.datasets.dataset import Dataset
from tacpipe.errors import TacpipeError
from tacpipe.io import Json, terminal
from tacpipe.plugins.stage import RecordingOutput, Result
from tacpipe.scores import headline, regression, table
from tacpipe.scores.calibration import COVERAGE_FILE
from tacpipe.scores.table import Question
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
from tacpipe.tasks.touch.predictions import UNNAMED, GraspPredictions, Readings
from tacpipe.tasks.touch.predictor import CONFIG, HISTORY, Predictor


def reading_measures(grasps: GraspPredictions, predictor: str, clusters: AnyArray) -> dict[str, Any]:
    """Return the errors of one predictor, by measure and target, and the number ``n`` of grasps; undefined ones are None.

    ``rmse`` and ``mae`` are fractions of each target's range (`biotac_sp.RANGES`), pooled over grasps and electrodes.
    ``rmse_counts`` is in device counts. ``rmse_batch_mean`` is the figure of the letter: the mean over batches of ten.
    ``skill`` is 1 - RMSE / RMSE of the constant, with a 95 % interval over ``clusters`` (grasp,).
    """
    measures: dict[str, Any] = {"n": len(grasps)}
    for target in grasps.targets:
        counts = (grasps.true[target], *(grasps.predicted[name][target] for name in (predictor, CONSTANT)))
        true, model, constant = (biotac_sp.normalise(target, values) for values in counts)
        model_sums, constant_sums = (regression.squared_sums(true, share) for share in (model, constant))
        skill, low, high = regression.skill_interval(model_sums, constant_sums, clusters)
        values = {
            "rmse": regression.rmse(true, model),
            "rmse_counts": regression.rmse(*counts[:2]),
            "rmse_batch_mean": regression.batch_mean_rmse(true, model),
            "mae": regression.mae(true, model),
            "r2": regression.r2(true, model),
            "skill": skill,
            "skill_low": low,
            "skill_high": high,
        }
        for name, value in values.items():
            measures.setdefault(name, {})[target] = _finite(value)
    return measures


def by_electrode(grasps: GraspPredictions) -> dict[str, dict[str, Any]]:
    """Return the model's RMSE (fraction of the range) and R2 of each electrode, by target."""
    by_target = {}
    for target in grasps.targets:
        if biotac_sp.width(target) > 1:
            counts = grasps.true[target], grasps.predicted[MODEL][target]
            true, share = (biotac_sp.normalise(target, values) for values in counts)
            pairs = zip(regression.rmse_by_value(true, share), regression.r2_by_value(true, share), strict=True)
            by_target[target] = {
                f"{number:02d}": {"rmse": float(rmse), "r2": _finite(float(r2))}
                for number, (rmse, r2) in enumerate(pairs, 1)
            }
    return by_target


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
    rows = GraspPredictions(np.array(grasps.names), np.array(grasps.objects), is_known, grasps.readings, predicted)
    unseen = rows.rows(~in_training)
    parts = {"known": unseen.rows(unseen.known), "novel": unseen.rows(~unseen.known), "seen": rows.rows(in_training)}
    fresh, quantile_measures = _scores(unseen), _quantiles(predictor, parts)
    tree = {
        **fresh,
        **{name: _scores(part) for name, part in parts.items() if len(part)},
        **({"quantiles": quantile_measures} if quantile_measures else {}),
    }
    tables = {
        Question(headlines.PARTS[known_objects], headlines.TARGETS[target]): scored
        for (known_objects, target), scored in unseen.tables().items()
    }
    files = {
        headline.FILE: headline.write(table.headlines(headlines.TASK, predictor.config["architecture"], tables)),
        "metrics.json": (json.dumps(tree, indent=1, sort_keys=True, allow_nan=False) + "\n").encode(),
        "by_object.csv": _object_csv(fresh),
        **{name: model[name] for name in (CONFIG, HISTORY) if name in model},
    }
    if predictor.quantiles is not None:
        files[COVERAGE_FILE] = quantiles.coverage(predictor.quantiles, unseen)
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


def _quantiles(predictor: Predictor, parts: Mapping[str, GraspPredictions]) -> Json:
    """Return the quantile measures of a calibrated model on known and on novel objects; empty for other models."""
    if predictor.quantiles is None:
        return {}
    clusters = {"known": parts["known"].recordings, "novel": parts["novel"].objects}
    measures = {
        name: {
            "n": len(parts[name]),
            **quantiles.measures_by_predictor(predictor.quantiles, parts[name], by_grasp),
        }
        for name, by_grasp in clusters.items()
        if len(by_grasp)
    }
    return {**predictor.config["quantiles"], **measures}


def _scores(grasps: GraspPredictions) -> dict[str, Any]:
    """Return the errors of every predictor, in total and by object, as ``metrics.json`` contains them.

    Intervals resample objects if any object is novel, otherwise grasps. The model has errors by electrode, too.
    """
    if not len(grasps):
        return {"counts": {"grasps": 0}}
    clusters = grasps.recordings if grasps.known.all() else grasps.objects
    by_object = {name: grasps.rows(grasps.objects == name) for name in sorted(set(grasps.objects.tolist()))}
    predictors = {
        name: {
            **reading_measures(grasps, name, clusters),
            "by_object": {
                own or UNNAMED: reading_measures(rows, name, rows.recordings) for own, rows in by_object.items()
            },
        }
        for name in grasps.predicted
    }
    predictors[MODEL]["by_electrode"] = by_electrode(grasps)
    return {"counts": {"grasps": len(grasps), "objects": len(by_object)}, **predictors}


OBJECT_MEASURES = ("rmse", "rmse_counts", "r2", "skill")


def _object_csv(scores: Json) -> bytes:
    """Return CSV with one row per object, predictor and target: grasps, relative RMSE, RMSE in counts, R2 and skill."""
    rows = []
    for predictor in (MODEL, CONSTANT, OBJECT_MEAN, NEAREST_IN_TIME):
        for name, measures in scores.get(predictor, {"by_object": {}})["by_object"].items():
            for target in measures["rmse"]:
                values = [measures[measure][target] for measure in OBJECT_MEASURES]
                rounded = ["" if value is None else f"{value:.6g}" for value in values]
                rows.append([name, predictor, target, measures["n"], *rounded])
    return model_files.to_csv(("object", "predictor", "target", "n", *OBJECT_MEASURES), rows)


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
