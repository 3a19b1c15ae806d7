"""Write and read the files of a model of windows: its configuration, its estimator and its baselines."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from safetensors.numpy import save

from tacpipe.arrays import AnyArray
from tacpipe.datasets import model_files
from tacpipe.tasks.learning import estimators
from tacpipe.tasks.learning.estimators import OutputEstimator
from tacpipe.tasks.learning.examples import blank
from tacpipe.tasks.learning.inputs import Inputs
from tacpipe.tasks.learning.params import EstimatorParams
from tacpipe.tasks.task import Files

MODEL, BASELINES = "estimator.safetensors", "baselines.safetensors"


def to_files(
    config: Mapping[str, Any], estimator: OutputEstimator, baselines: Mapping[str, OutputEstimator]
) -> dict[str, bytes]:
    """Return the files of a model. Its configuration gets the settings of estimator and baselines that are not arrays."""
    described = {name: baseline.describe() for name, baseline in baselines.items()}
    arrays = {f"{name}.{part}": array for name, own in baselines.items() for part, array in own.arrays().items()}
    return {
        model_files.CONFIG: model_files.to_json({**config, "estimator": estimator.describe(), "baselines": described}),
        MODEL: save(_contiguous(estimator.arrays())),
        BASELINES: save(_contiguous(arrays)),
    }


def from_files(
    files: Files, config: Mapping[str, Any], params: EstimatorParams, inputs: Inputs, outputs: int
) -> tuple[OutputEstimator, dict[str, OutputEstimator]]:
    """Return the estimator and the baselines by name. Raises `ValueError` if they do not fit the inputs or each other."""
    all_arrays = model_files.arrays(files[BASELINES], BASELINES)
    baselines = {}
    for name, described in config["baselines"].items():
        own = {key.removeprefix(f"{name}."): part for key, part in all_arrays.items() if key.startswith(f"{name}.")}
        baselines[name] = estimators.load(own, described, outputs)
    arrays = model_files.arrays(files[MODEL], MODEL, but="chosen")  # an error that some readouts do not have
    load = estimators.load if config["chosen"] in baselines else params.load_estimator
    estimator = load(arrays, config["estimator"], outputs)
    for part in (estimator, *baselines.values()):
        part.outputs(blank(inputs))
    return estimator, baselines


def _contiguous(arrays: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    return {name: np.ascontiguousarray(array) for name, array in arrays.items()}
