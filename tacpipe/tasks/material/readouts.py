"""Fit models without epochs: convolutional features, statistics or spectra with a readout."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import numpy as np
from safetensors.numpy import save

from tacpipe.datasets import model_files
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.models import transfer
from tacpipe.models.readout import Level
from tacpipe.models.transfer import Bands, Sampling, Transfer
from tacpipe.plugins.constraints import Assignments
from tacpipe.tasks.material.classifier import BASELINES, CONFIG, WEIGHTS, ReadoutModel
from tacpipe.tasks.material.headline import Naming
from tacpipe.tasks.material.params import (
    MEAN_LEVEL,
    PERMUTED_LABELS,
    MaterialConfig,
    Params,
    ReadoutParams,
    Spectra,
)
from tacpipe.tasks.material.slides import BySensor, Slides

Arrays = dict[str, np.ndarray]


def fit_readouts(
    params: ReadoutParams, config: MaterialConfig, training_slides: BySensor, validation_slides: BySensor
) -> dict[str, bytes]:
    """Return the files of features and a readout per sensor. Raises the errors of the classifier's ``fit``.

    Beside the mean level, the baselines are the same readout of shuffled labels, and of the views of ``params``.
    """
    tensors: Arrays = {}
    baselines: Arrays = {}
    fit: Callable[..., ReadoutModel] = params.model.fit
    for index, (name, slides) in enumerate(training_slides.items()):
        frames, materials = _training_arrays(params, slides, validation_slides.get(name), index)
        fitted = fit(frames, materials, **params.settings)
        tensors |= {f"{name}.{key}": value for key, value in fitted.to_tensors().items()}
        if params.baselines:
            shuffled = fit(frames, shuffled_labels(params, materials, index), **params.settings)
            baselines |= baseline_tensors(MEAN_LEVEL, name, Level.fit(frames, materials))
            baselines |= baseline_tensors(PERMUTED_LABELS, name, shuffled)
            for kind, view in params.VIEWS.items():
                baselines |= baseline_tensors(kind, name, fit(frames, materials, view=view))
    return _files(config, tensors, baselines)


def fit_spectra(
    params: Spectra,
    config: MaterialConfig,
    training_slides: BySensor,
    validation_slides: BySensor,
    held_out: Mapping[str, Iterable[int]],
) -> dict[str, bytes]:
    """Return the files of spectra over spatial frequency, through which sensors learn materials from each other.

    ``held_out`` contains the materials whose labels a sensor does not learn; their slides are not used to fit it.
    Raises `TacpipeError` if a sensor's speed or rate is unknown, sensors share too few materials, or a material is
    learned by no sensor.
    """
    samplings = _samplings(params.speeds, training_slides)
    bands = Bands.common(list(samplings.values()))
    labelled: dict[str, transfer.Labelled] = {}
    baselines: Arrays = {}
    for index, (name, slides) in enumerate(training_slides.items()):
        frames, materials = _training_arrays(params, slides, validation_slides.get(name), index)
        is_learned = ~np.isin(materials, list(held_out[name]))
        frames, materials = frames[is_learned], materials[is_learned]
        spectra = bands.log_power(frames, samplings[name].rate_hz, samplings[name].speed_m_s)
        labelled[name] = transfer.Labelled(spectra, materials)
        if params.baselines:
            shuffled = shuffled_labels(params, materials, index)
            baselines |= baseline_tensors(MEAN_LEVEL, name, Level.fit(frames, materials))
            baselines |= baseline_tensors(PERMUTED_LABELS, name, Level.fit(labelled[name].features[:, None], shuffled))
    learned = {name: {int(number) for number in sensor_labels.labels} for name, sensor_labels in labelled.items()}
    missing = sorted(set(config["classes"]) - set().union(*learned.values()))
    if missing:
        raise UsageError(
            f"hold_out leaves no sensor that learns {Naming.from_json(config).name(missing[0])}; leave at least one."
        )
    config["spectra"] = {
        "way_m": bands.distance_m,
        "edges_per_m": bands.edges_per_m.tolist(),
        "speed_m_s": {name: sampling.speed_m_s for name, sampling in samplings.items()},
    }
    config["held_out"] = {
        name: sorted(set(config["classes"]) - learned_materials) for name, learned_materials in learned.items()
    }
    tensors: Arrays = {}
    for name, training_spectra in labelled.items():
        fitted = Transfer.fit(training_spectra, [labelled[other] for other in labelled if other != name])
        tensors |= {f"{name}.{key}": value for key, value in fitted.to_tensors().items()}
    return _files(config, tensors, baselines)


def _samplings(speeds: str, training_slides: BySensor) -> dict[str, Sampling]:
    """Return the sampling of each sensor's slides, at their median recorded speed.

    ``speeds``, such as ``biotac=0.025,roboskin=0.05``, is used for sensors whose slides have no recorded speed. Raises
    `UsageError` if it lacks one, and `TacpipeError` if slides have no rate.
    """
    stated_speeds = Assignments(float).items(speeds)
    samplings = {}
    for name, slides in training_slides.items():
        recorded = slides.speeds_m_s[slides.speeds_m_s > 0]
        if not len(recorded) and name not in stated_speeds:
            raise UsageError(
                f"The slides of {name} have no speed, and speeds is {speeds!r}; add {name}=0.05, or what it is."
            )
        if slides.layout.rate_hz <= 0:
            raise TacpipeError(
                f"{slides.names[0]} has no rate, and the length of a wave needs one; set it with "
                f"`tacpipe label RECORDINGS {slides.names[0]} --label rate_hz=100`, or what it is."
            )
        speed_m_s = float(np.median(recorded)) if len(recorded) else stated_speeds[name]
        samplings[name] = Sampling(slides.layout.frames, slides.layout.rate_hz, speed_m_s)
    return samplings


def _training_arrays(
    params: ReadoutParams | Spectra,
    training_slides: Slides,
    validation_slides: Slides | None,
    index: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the frames and materials for training, with those of validation if the params request them.

    Materials are permuted if ``params`` say so; ``index`` is the sensor's.
    """
    frames, materials = training_slides.frames, permute_labels(params, training_slides.materials, index)
    if params.use_validation and validation_slides is not None and params.labels == "true":
        frames = np.concatenate([frames, validation_slides.frames])
        materials = np.concatenate([materials, validation_slides.materials])
    return frames, materials


def permute_labels(params: Params, materials: np.ndarray, index: int) -> np.ndarray:
    """Return labels, permuted among the slides if the params request it as a control."""
    if params.labels == "true":
        return materials
    return np.random.default_rng([params.seed, 2, index]).permutation(materials)


def shuffled_labels(params: Params, materials: np.ndarray, index: int) -> np.ndarray:
    """Return the labels of a sensor's slides in random order, for the baseline that learned nothing."""
    return np.random.default_rng([params.seed, 3, index]).permutation(materials)


def baseline_tensors(kind: str, sensor: str, fitted: Level | ReadoutModel) -> Arrays:
    """Return the tensors of a baseline, under unique names."""
    return {f"{kind}.{sensor}.{key}": value for key, value in fitted.to_tensors().items()}


def pack(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return arrays as file content."""
    return save({name: np.ascontiguousarray(array) for name, array in arrays.items()})


def _files(config: MaterialConfig, tensors: Arrays, baselines: Arrays) -> dict[str, bytes]:
    files = {CONFIG: model_files.to_json(config), WEIGHTS: pack(tensors)}
    return {**files, BASELINES: pack(baselines)} if baselines else files
