"""Train classifiers of materials: networks, separate, joint or aligned to a frozen one, and fitted readouts."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import torch
from safetensors.torch import save as save_tensors
from torch import nn

from tacpipe.datasets import model_files
from tacpipe.datasets.dataset import Dataset
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.models import recurrent_autoencoder
from tacpipe.models.readout import Level
from tacpipe.models.recurrent_autoencoder import AutoencoderShape
from tacpipe.plugins import params as params_of
from tacpipe.plugins.constraints import CommaList
from tacpipe.printable import listed
from tacpipe.tasks import recordings
from tacpipe.tasks.material import networks as networks_of
from tacpipe.tasks.material import readouts
from tacpipe.tasks.material import slides as slides_of
from tacpipe.tasks.material.classifier import (
    BASELINES,
    CONFIG,
    LAST,
    TASK,
    WEIGHTS,
    Classifier,
    NetworkReader,
)
from tacpipe.tasks.material.headline import Naming
from tacpipe.tasks.material.losses import NONE, BatchPairs, JointWork, ScaledSlides, permuted_classes
from tacpipe.tasks.material.params import (
    MEAN_LEVEL,
    PERMUTED_LABELS,
    BestEpochs,
    MaterialConfig,
    Params,
    ReadoutParams,
    Spectra,
    aligning_architectures,
)
from tacpipe.tasks.material.params import NetworkParams as NetworkParams
from tacpipe.tasks.material.slides import BySensor, Slides
from tacpipe.training import devices, loop
from tacpipe.training.following import Line, history_bytes
from tacpipe.training.scaling import Affine

HISTORY = "history.jsonl"


def train_network(
    params: NetworkParams,
    config: MaterialConfig,
    training_slides: BySensor,
    validation_slides: BySensor,
    workspace: Path,
    init: Mapping[str, bytes] | None,
) -> dict[str, bytes]:
    """Return the files of networks, one per sensor, trained on ``training_slides`` and selected on ``validation_slides``.

    Completes ``config``. Raises `TacpipeError` if a sensor has no validation slides or, for joint learning, lacks
    materials, and `UsageError` if the initial model is incompatible.
    """
    missing = sorted(set(training_slides) - set(validation_slides))
    if missing:
        raise TacpipeError(
            f"No recording of {missing[0]} has the role val, and a network is chosen by its validation slides. "
            f"Make a split that has some of every sensor."
        )
    device = devices.kind()
    start = Classifier.load(init) if init else None
    joint = params.learns_jointly and len(training_slides) > 1
    mapped_to = params.aligned_sensor
    if joint:
        _require_same_materials(training_slides, Naming.from_json(config))
    kinds = recurrent_autoencoder.parse_headers(
        params.headers, {name: len(sensor_slides.layout.channels) for name, sensor_slides in training_slides.items()}
    )
    shapes = {
        name: params.shape(len(sensor_slides.layout.channels), kinds[name], len(config["classes"]))
        for name, sensor_slides in training_slides.items()
    }
    scalings = {
        name: Affine.fit(sensor_slides.frames, params.scaling) for name, sensor_slides in training_slides.items()
    }
    held_out_materials = slides_of.held_out_materials(
        params.hold_out, config["classes"], training_slides, Naming.from_json(config)
    )
    frozen = _frozen_network(start, mapped_to, config, training_slides) if start else None
    if start and frozen:
        shapes[mapped_to] = AutoencoderShape(**start.config["shapes"][mapped_to])
        scalings[mapped_to] = frozen.scaling
        config["trained_on"] = recordings.add_earlier(config["trained_on"], start.config["trained_on"])
    training, validation = (
        {
            name: _scaled_slides(params, config, sensor_slides, scalings[name], held_out_materials, device, index)
            for index, (name, sensor_slides) in enumerate(part.items())
        }
        for part in (training_slides, validation_slides)
    )
    classes = range(len(config["classes"]))
    partners = permuted_classes(classes, params.seed) if params.pairing_method == "permuted" else None
    _add_networks(config, shapes, scalings, held_out_materials, partners)
    config["joint"] = joint
    pairs = _pairs(params, training, partners)
    work = JointWork(training, validation, pairs, params.loss_weights(joint=joint), mapped_to, params.drop_last)

    def build() -> nn.Module:
        networks = _build_networks(params, shapes, frozen, mapped_to).to(device)
        for name, network in networks.items():
            networks_of.check_network(network, params, training[name].frames, shapes[name].classes)
        return networks

    trained = loop.train(build, work, loop.Schedule.from_params(params, params.seed), workspace)
    config["validation"] = _best_epochs(trained.history, work.joint)
    files = _files(trained, config, params)
    if params.baselines:
        files[BASELINES] = _network_baselines(Classifier.load(files), training_slides, params)
    return files


def _add_networks(
    config: MaterialConfig,
    shapes: Mapping[str, AutoencoderShape],
    scalings: Mapping[str, Affine],
    held_out_materials: Mapping[str, set[int]],
    partners: Mapping[int, int] | None,
) -> None:
    """Add the shapes, scalings, held-out materials and partner classes of the networks to ``config``."""
    config["shapes"] = {name: dataclasses.asdict(shape) for name, shape in shapes.items()}
    config["scaling"] = {
        name: {key: value.tolist() for key, value in scaling.to_tensors().items()} for name, scaling in scalings.items()
    }
    config["held_out"] = {name: sorted(materials) for name, materials in held_out_materials.items()}
    if partners is not None:
        classes = config["classes"]
        config["partners"] = {str(classes[number]): classes[partner] for number, partner in sorted(partners.items())}


def _files(trained: loop.TrainingResult, config: MaterialConfig, params: NetworkParams) -> dict[str, bytes]:
    """Return the files of trained networks: the selected weights, and those of the last epoch."""
    best, last = (trained.weights, trained.last) if params.select == "best" else (trained.last, trained.weights)
    files = {CONFIG: model_files.to_json(config), WEIGHTS: save_tensors(best), HISTORY: history_bytes(trained.history)}
    if params.select == "best":
        files[LAST] = save_tensors(last)
    return files


def _pairs(params: NetworkParams, slides: Mapping[str, ScaledSlides], partners: Mapping[int, int] | None) -> BatchPairs:
    """Return the pairs of slides that a training draws in each epoch."""
    return BatchPairs(
        {name: scaled.classes.cpu() for name, scaled in slides.items()},
        params.batch,
        pairing=params.pairing_method,
        shuffle=params.shuffle,
        drop_last=params.drop_last,
        subsample_sensor=params.subsample_sensor,
        subsample_percent=params.subsample_percent,
        partners=partners,
        seed=params.seed,
    )


def _scaled_slides(
    params: NetworkParams,
    config: MaterialConfig,
    slides: Slides,
    scaling: Affine,
    held_out_materials: Mapping[str, set[int]],
    device: str,
    sensor_index: int,
) -> ScaledSlides:
    """Return slides as network input. Slides of held-out classes and of classes without training slides have no label.

    Raises `TacpipeError` if no label is left.
    """
    name = slides.layout.sensor
    index_by_material = {
        material: class_index
        for class_index, material in enumerate(config["classes"])
        if material not in held_out_materials[name]
    }
    materials = readouts.permute_labels(params, slides.materials, sensor_index)
    classes = torch.tensor([index_by_material.get(int(material), NONE) for material in materials])
    if not (classes != NONE).any():
        raise TacpipeError(f"hold_out leaves {name} no material to learn; leave at least one.")
    return ScaledSlides(torch.from_numpy(scaling.apply(slides.frames)).to(device), classes.to(device))


def _require_same_materials(training_slides: BySensor, naming: Naming) -> None:
    """Raise `TacpipeError` for joint learning if a sensor lacks a material that another has."""
    materials = {
        name: {int(material) for material in sensor_slides.materials} for name, sensor_slides in training_slides.items()
    }
    all_materials = set().union(*materials.values())
    for name, sensor_materials in materials.items():
        if sensor_materials != all_materials:
            lacking = ", ".join(map(naming.name, sorted(all_materials - sensor_materials)))
            raise TacpipeError(
                f"{name} has no training slide of {naming.key} {lacking}, which other sensors have, so they cannot be "
                f"learned jointly. Exclude those slides, record the material, or train with --no-joint."
            )


def _frozen_network(start: Classifier, frozen_sensor: str, config: MaterialConfig, slides: BySensor) -> NetworkReader:
    """Return the network of the frozen sensor in the --init model.

    Raises `TacpipeError` if the model lacks the sensor or has other materials, and `UsageError` if the recordings lack it.
    """
    if frozen_sensor not in slides:
        raise UsageError(f"frozen_sensor is {frozen_sensor}; the recordings are of {', '.join(slides)}.")
    networks = {name: reader for name, reader in start.readers.items() if isinstance(reader, NetworkReader)}
    if not start.params.ALIGNS_SENSORS or not networks:
        raise TacpipeError(
            f"The model of --init is of the architecture {start.architecture}; its space must be of "
            f"{' or '.join(aligning_architectures())}."
        )
    start.check(slides[frozen_sensor])
    if list(start.classes) != config["classes"] or start.naming != Naming.from_json(config):
        raise TacpipeError(
            f"The model of --init names {listed(map(start.naming.name, start.classes))} and the recordings have "
            f"{listed(map(Naming.from_json(config).name, config['classes']))}; a known space is that of the same ones."
        )
    return networks[frozen_sensor]


def _build_networks(
    params: NetworkParams, shapes: Mapping[str, AutoencoderShape], frozen: NetworkReader | None, frozen_sensor: str
) -> nn.ModuleDict:
    """Return the networks by sensor; ``frozen`` is copied to its sensor and frozen, and all others use its classifier."""
    networks = nn.ModuleDict(
        {name: cast(nn.Module, networks_of.build_network(params, shape)) for name, shape in shapes.items()}
    )
    if frozen:
        for name, network in networks.items():
            if name == frozen_sensor:
                network.load_state_dict(frozen.network.state_dict())
                network.requires_grad_(False)
            else:
                network.get_submodule("classifier").load_state_dict(frozen.network.classifier.state_dict())
                network.get_submodule("classifier").requires_grad_(False)
    return networks


def _best_epochs(history: Sequence[Line], joint: bool) -> BestEpochs:
    """Return the epoch of the best validation accuracy of each sensor, the latest of equal ones, and that accuracy.

    If ``joint``, the epoch has the highest sum of accuracies over sensors.
    """

    def best_line(sensor: str) -> Line:
        sensors = list(history[0]["val"]) if joint else [sensor]
        return max(history, key=lambda line: (sum(line["val"][name]["accuracy"] for name in sensors), line["epoch"]))

    best_lines = {sensor: best_line(sensor) for sensor in history[0]["val"]}
    return {
        "epoch": {sensor: line["epoch"] for sensor, line in best_lines.items()},
        "accuracy": {sensor: line["val"][sensor]["accuracy"] for sensor, line in best_lines.items()},
    }


def _network_baselines(trained: Classifier, training_slides: BySensor, params: Params) -> bytes:
    """Return the mean-level baseline, and a readout of the networks' latents fitted to shuffled labels."""
    arrays: dict[str, np.ndarray] = {}
    for index, (name, slides) in enumerate(training_slides.items()):
        latents = trained.readers[name].read(slides.frames).latents
        assert latents is not None
        shuffled = readouts.shuffled_labels(params, slides.materials, index)
        arrays |= readouts.baseline_tensors(MEAN_LEVEL, name, Level.fit(slides.frames, slides.materials))
        arrays |= readouts.baseline_tensors(PERMUTED_LABELS, name, Level.fit(latents[:, None], shuffled))
    return readouts.pack(arrays)


@dataclass(frozen=True)
class TrainingSlides:
    """Slides and settings for the ``fit`` of an architecture, and the training methods that the task offers."""

    config: MaterialConfig  # the model's configuration, as far as the data determine it
    training: BySensor
    validation: BySensor
    naming: Naming
    workspace: Path  # folder for checkpoints, so that training can resume
    init: Mapping[str, bytes] | None  # files of the ``--init`` model

    def fit_readouts(self, params: ReadoutParams) -> dict[str, bytes]:
        """Return the files of features and a readout for each sensor."""
        return readouts.fit_readouts(params, self.config, self.training, self.validation)

    def fit_spectra(self, params: Spectra) -> dict[str, bytes]:
        """Return the files of spectra, through which sensors learn materials from each other."""
        excluded = slides_of.held_out_materials(params.hold_out, self.config["classes"], self.training, self.naming)
        return readouts.fit_spectra(params, self.config, self.training, self.validation, excluded)

    def train_networks(self, params: NetworkParams) -> dict[str, bytes]:
        """Return the files of one network per sensor, trained by the shared loop."""
        return train_network(params, self.config, self.training, self.validation, self.workspace, self.init)


def train(
    params: Params,
    training: Dataset,
    validation: Dataset | None,
    workspace: Path,
    init: Mapping[str, bytes] | None = None,
) -> dict[str, bytes]:
    """Return the files of a model trained on the slides of ``training``; networks are selected on ``validation``.

    Everything is fitted on training slides only. A closed-form readout needs no validation slides; with
    ``use_validation`` it is fitted on them as well. Raises `TacpipeError` if slides lack labels, differ in layout or,
    for joint learning, in materials.
    """
    _check_init(params, init)
    only = CommaList().items(params.sensors)
    kinds = tuple(CommaList().items(params.quantities)) or params.QUANTITIES
    naming = _label_naming(params.label, training, validation)
    training_slides = slides_of.read(training, only=only, quantities=kinds, naming=naming, labelled=True)
    validation_slides: BySensor = {}
    if validation is not None and validation.recordings:
        validation_slides = slides_of.read(validation, only=only, quantities=kinds, naming=naming, labelled=True)
    if not training_slides:
        raise TacpipeError("There is no training recording. Make a split with `tacpipe split` that has some.")
    classes = sorted({int(material) for slides in training_slides.values() for material in slides.materials})
    if len(classes) < 2:
        raise TacpipeError(
            f"All training slides are of {naming.key} {naming.name(classes[0])}; there is nothing to classify."
        )
    absent = slides_of.absent_quantities(training, kinds)
    config: MaterialConfig = {
        "task": TASK,
        "architecture": params.architecture,
        "params": params_of.to_json(params),
        "split": params.run_label,
        "quantities": kinds,
        "sensors": {name: slides.layout.to_json() for name, slides in training_slides.items()},
        "classes": classes,
        "counts": {
            role: {name: len(slides) for name, slides in part.items()}
            for role, part in (("train", training_slides), ("val", validation_slides))
        },
        "trained_on": recordings.merge_trained_on(
            *(
                zip(slides.names, slides.digests, strict=True)
                for slides in (*training_slides.values(), *validation_slides.values())
            )
        ),
    }
    naming.add_to_config(config)
    if absent:
        config["absent"] = absent
    return params.fit(TrainingSlides(config, training_slides, validation_slides, naming, workspace, init))


def _label_naming(key: str, *parts: Dataset | None) -> Naming:
    """Return the naming of the labels ``key`` of all training and validation recordings."""
    shards = [shard for part in parts if part is not None for shard in part.recordings.values()]
    return Naming.from_labels(key, (shard.attributes.get(key) for shard in shards))


def _check_init(params: Params, init: Mapping[str, bytes] | None) -> None:
    """Raise `UsageError` for an unused initial model, and for a frozen sensor without an initial model."""
    if init is not None and not params.ALIGNS_SENSORS:
        able = " or ".join(aligning_architectures())
        raise UsageError(
            f"--init goes with the architecture {able} only, whose networks can be aligned to that of a frozen sensor, "
            f"not with {params.architecture}. Leave it out, or choose --architecture {able}."
        )
    if bool(params.aligned_sensor) != (init is not None):
        raise UsageError(
            "Alignment to a trained network needs both --frozen-sensor, the sensor that it is of, and --init, the model "
            "that holds it."
        )
