"""Train a classifier of materials: from slides and params to the files of a model."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from safetensors.torch import save as save_tensors
from torch import nn

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.models import headers
from tacpipe.models.level import Level
from tacpipe.models.recurrent_autoencoder import Shape
from tacpipe.plugins import params as params_of
from tacpipe.plugins.constraints import Assignments, CommaList
from tacpipe.printable import listed
from tacpipe.tasks.material import networks, readouts
from tacpipe.tasks.material import slides as slides_of
from tacpipe.tasks.material.classifier import (
    BASELINES,
    CONFIG,
    LAST,
    MEAN_LEVEL,
    PERMUTED_LABELS,
    ROCKET,
    STATISTICS,
    TASK,
    WEIGHTS,
    Classifier,
    Config,
    NetworkReader,
)
from tacpipe.tasks.material.losses import JointWork, ScaledSlides, Weights
from tacpipe.tasks.material.naming import NUMBERS, UNKNOWN, Naming
from tacpipe.tasks.material.pairs import NONE, Pairs, permuted_classes
from tacpipe.tasks.material.params import Estimator, Minirocket, Params, Raec, Spectra, Statistics
from tacpipe.tasks.material.params import Network as NetworkParams
from tacpipe.tasks.material.slides import Slides
from tacpipe.tasks.seen import seen
from tacpipe.training import devices, loop
from tacpipe.training.scaling import Affine

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

HISTORY = "history.jsonl"
RAEC = "raec"
QUANTITIES = dict.fromkeys(
    (ROCKET, STATISTICS), (slides_of.TACTILE, "vibration")
)  # that are read where params name none
MAPPED_RECONSTRUCTION = 0.05  # weight of a network that is aligned to a frozen one: that of the published script

BySensor = Mapping[str, Slides]


def train(
    params: Params,
    training: Dataset,
    validation: Dataset | None,
    workspace: Path,
    init: Mapping[str, bytes] | None = None,
) -> dict[str, bytes]:
    """Return the files of a model trained on the slides of ``training`` and, for networks, chosen on ``validation``.

    Whatever is fitted is fitted on training slides alone; a readout
    in closed form needs none to choose by, and learns from validation slides too where ``use_validation`` is set.
    Raises `TacpipeError` where slides lack labels, differ in layout or, learned jointly, in materials.
    """
    _check(params, init)
    only = CommaList().items(params.sensors)
    kinds = slides_of.quantities(params.quantities) or QUANTITIES.get(params.architecture, (slides_of.TACTILE,))
    naming = _naming(params.label, training, validation)
    known = slides_of.read(training, only=only, quantities=kinds, naming=naming, labelled=True)
    watched: dict[str, Slides] = {}
    if validation is not None and validation.recordings:
        watched = slides_of.read(validation, only=only, quantities=kinds, naming=naming, labelled=True)
    if not known:
        raise TacpipeError("There is no training recording. Make a split with `tacpipe split` that has some.")
    classes = sorted({int(one) for some in known.values() for one in some.materials})
    if len(classes) < 2:
        raise TacpipeError(
            f"All training slides are of {naming.key} {naming.name(classes[0])}; there is nothing to classify."
        )
    absent = slides_of.absent_quantities(training, kinds)
    config: Config = {
        "task": TASK,
        "architecture": params.architecture,
        "params": params_of.to_json(params),
        "split": params.run_label,
        "quantities": kinds,
        "sensors": {name: some.layout.to_json() for name, some in known.items()},
        "classes": classes,
        **naming.to_json(),
        **({"absent": absent} if absent else {}),
        "counts": {
            role: {name: len(some) for name, some in part.items()}
            for role, part in (("train", known), ("val", watched))
        },
        "trained_on": {
            name: digest
            for part in (known, watched)
            for some in part.values()
            for name, digest in zip(some.names, some.digests, strict=True)
        },
    }
    if isinstance(params, Minirocket):
        return readouts.rockets(params, config, known, watched)
    if isinstance(params, Statistics):
        return readouts.statistics(params, config, known, watched)
    if isinstance(params, Spectra):
        return readouts.spectra(params, config, known, watched, held_out(params.hold_out, classes, known, naming))
    if isinstance(params, Estimator):
        return readouts.estimators(params, config, known, watched)
    if isinstance(params, NetworkParams):
        return _networks(params, config, known, watched, workspace, init)
    raise TacpipeError(
        f"The params of the architecture {params.architecture} extend neither Estimator nor Network of "
        f"tacpipe.tasks.material.params, so the task cannot train it."
    )


def _naming(key: str, *parts: Dataset | None) -> Naming:
    """Return the naming of the labels ``key`` of all recordings to learn from or to choose by."""
    every = [shard for part in parts if part is not None for shard in part.recordings.values()]
    return Naming.of(key, (shard.attributes.get(key) for shard in every))


def _check(params: Params, init: Mapping[str, bytes] | None) -> None:
    """Refuse a model to begin with where nothing is learned from it, and a frozen sensor without one."""
    if init is not None and not isinstance(params, Raec):
        raise UsageError(
            f"--init goes with the architecture {RAEC} alone, whose networks can be aligned to that of a frozen sensor, "
            f"not with {params.architecture}. Leave it out, or choose --architecture {RAEC}."
        )
    if bool(_frozen(params)) != (init is not None):
        raise UsageError(
            "Alignment to a trained network needs both --frozen-sensor, the sensor that it is of, and --init, the model "
            "that holds it."
        )


def _frozen(params: Params) -> str:
    """Return the sensor whose network is frozen; the empty text where none is."""
    return params.frozen_sensor if isinstance(params, Raec) else ""


# ---- networks


def _networks(
    params: NetworkParams,
    config: Config,
    known: BySensor,
    watched: BySensor,
    workspace: Path,
    init: Mapping[str, bytes] | None,
) -> dict[str, bytes]:
    missing = sorted(set(known) - set(watched))
    if missing:
        raise TacpipeError(
            f"No recording of {missing[0]} has the role val, and a network is chosen by its validation slides. "
            f"Make a split that has some of every sensor."
        )
    device = devices.kind()
    start = Classifier.load(init) if init else None
    joint = isinstance(params, Raec) and params.joint and len(known) > 1
    mapped_to = _frozen(params)
    if joint:
        _same_materials(known, Naming.from_json(config))
    kinds = headers.chosen(params.headers, {name: len(some.layout.channels) for name, some in known.items()})
    shapes = {name: _shape(params, some, kinds[name], len(config["classes"])) for name, some in known.items()}
    scalings = {name: Affine.fit(some.frames, params.scaling) for name, some in known.items()}
    held = held_out(params.hold_out, config["classes"], known, Naming.from_json(config))
    if start:
        _same_space(start, mapped_to, config, known)
        shapes[mapped_to] = Shape(**start.config["shapes"][mapped_to])
        scalings[mapped_to] = _reader(start, mapped_to).scaling
        config["trained_on"] = seen(config["trained_on"], start.config["trained_on"])
    scaled_slides = [
        {
            name: _scaled(params, config, some, scalings[name], held, device, place)
            for place, (name, some) in enumerate(part.items())
        }
        for part in (known, watched)
    ]
    config |= {
        "shapes": {name: dataclasses.asdict(shape) for name, shape in shapes.items()},
        "scaling": {
            name: {key: value.tolist() for key, value in one.to_tensors().items()} for name, one in scalings.items()
        },
        "joint": joint,
        "held_out": {name: sorted(materials) for name, materials in held.items()},
    }
    partners = None
    if isinstance(params, Raec) and params.pairing == "permuted":
        partners = permuted_classes(range(len(config["classes"])), params.seed)
        config["partners"] = {
            str(config["classes"][one]): config["classes"][other] for one, other in sorted(partners.items())
        }
    pairs = _pairs(params, scaled_slides[0], partners)
    work = JointWork(scaled_slides[0], scaled_slides[1], pairs, _weights(params, joint), mapped_to, params.drop_last)

    def build() -> nn.Module:
        made = _built(params, shapes, start, mapped_to).to(device)
        for name, network in made.items():
            networks.check(network, params, scaled_slides[0][name].frames, shapes[name].classes)
        return made

    trained = loop.train(build, work, _schedule(params), workspace)
    best, last = (trained.weights, trained.last) if params.select == "best" else (trained.last, trained.weights)
    config["validation"] = _validation(trained.history, work.joint)
    files = {
        CONFIG: readouts.config_file(config),
        WEIGHTS: save_tensors(best),
        HISTORY: trained.history_lines,
    }
    if params.select == "best":
        files[LAST] = save_tensors(last)
    if params.baselines:
        files[BASELINES] = _network_baselines(Classifier.load(files), known, params)
    return files


def _pairs(params: NetworkParams, slides: Mapping[str, ScaledSlides], partners: Mapping[int, int] | None) -> Pairs:
    return Pairs(
        {name: some.classes.cpu() for name, some in slides.items()},
        params.batch,
        pairing=params.pairing if isinstance(params, Raec) else Pairs.pairing,
        shuffle=params.shuffle,
        drop_last=params.drop_last,
        subsample_sensor=params.subsample_sensor,
        subsample_percent=params.subsample_percent,
        partners=partners,
        seed=params.seed,
    )


def _schedule(params: NetworkParams) -> loop.Schedule:
    return loop.Schedule(
        epochs=params.epochs,
        batch=params.batch,
        learning_rate=params.learning_rate,
        patience=params.patience or params.epochs,
        gradient_clip=math.inf,
        seed=params.seed,
        cycle=params.cycle,
        precision=params.precision,
    )


def _shape(params: NetworkParams, some: Slides, header: str, classes: int) -> Shape:
    shape = Shape(channels=len(some.layout.channels), classes=classes, header=header, hidden=params.hidden)
    if not isinstance(params, Raec):
        return shape
    return dataclasses.replace(
        shape, decoder=params.decoder, latents=params.latents, unpool=params.unpool, dropout=params.dropout
    )


def _scaled(
    params: NetworkParams,
    config: Config,
    some: Slides,
    scaled: Affine,
    held: Mapping[str, set[int]],
    device: str,
    place: int,
) -> ScaledSlides:
    """Return slides as networks read them; what is held out or not among the training slides' classes has no label."""
    name = some.layout.sensor
    numbers = {material: number for number, material in enumerate(config["classes"]) if material not in held[name]}
    materials = readouts.permuted(params, some.materials, place)
    classes = torch.tensor([numbers.get(int(material), NONE) for material in materials])
    if not (classes != NONE).any():
        raise TacpipeError(f"hold_out leaves {name} no material to learn; leave at least one.")
    return ScaledSlides(torch.from_numpy(scaled.apply(some.frames)).to(device), classes.to(device))


def held_out(
    given: str, classes: Sequence[int], sensors: Sequence[str] | BySensor, naming: Naming = NUMBERS
) -> dict[str, set[int]]:
    """Return the materials whose labels each sensor does not learn; ``given`` is like ``roboskin=17,18,19,20``.

    >>> held_out("b=3,4", [1, 2, 3, 4], ["a", "b"])
    {'a': set(), 'b': {3, 4}}
    """
    found: dict[str, set[int]] = {name: set() for name in sensors}
    for name, numbers in Assignments(str, between=";").items(given).items():
        try:
            materials = {naming.read(word) for word in CommaList().items(numbers)}
        except ValueError:
            materials = {UNKNOWN}
        if name not in found or not materials <= set(classes):
            raise UsageError(
                f"hold_out names {name}={numbers}; the sensors are {', '.join(found)} and the classes "
                f"{listed(map(naming.name, classes), 20)}."
            )
        found[name] |= materials
    return found


def _same_materials(known: BySensor, naming: Naming) -> None:
    """Refuse joint learning where a sensor lacks a material that another has."""
    materials = {name: {int(one) for one in some.materials} for name, some in known.items()}
    every = set().union(*materials.values())
    for name, own in materials.items():
        if own != every:
            lacking = ", ".join(map(naming.name, sorted(every - own)))
            raise TacpipeError(
                f"{name} has no training slide of {naming.key} {lacking}, which other sensors have, so they cannot be "
                f"learned jointly. Exclude those slides, record the material, or train with --no-joint."
            )


def _same_space(start: Classifier, known: str, config: Config, slides: BySensor) -> None:
    """Refuse a model of --init that does not know the sensor or the same materials."""
    if known not in slides:
        raise UsageError(f"frozen_sensor is {known}; the recordings are of {', '.join(slides)}.")
    if start.architecture != RAEC:
        raise TacpipeError(
            f"The model of --init is of the architecture {start.architecture}; its space must be of {RAEC}."
        )
    start.check(slides[known])
    if list(start.classes) != config["classes"] or start.naming != Naming.from_json(config):
        raise TacpipeError(
            f"The model of --init names {listed(map(start.naming.name, start.classes))} and the recordings have "
            f"{listed(map(Naming.from_json(config).name, config['classes']))}; "
            f"a known space is that of the same ones."
        )


def _reader(start: Classifier, sensor: str) -> NetworkReader:
    reader = start.readers[sensor]
    assert isinstance(reader, NetworkReader)
    return reader


def _weights(params: NetworkParams, joint: bool) -> Weights:
    if not isinstance(params, Raec):
        return Weights(alignment=0.0)
    return Weights(
        reconstruction=MAPPED_RECONSTRUCTION if params.frozen_sensor else params.reconstruction_weight,
        classification=params.classification_weight,
        alignment=params.alignment_weight if joint else 0.0,
        align_from=params.align_from,
        alignment_loss=params.alignment_loss,
    )


def _built(params: NetworkParams, shapes: Mapping[str, Shape], start: Classifier | None, frozen: str) -> nn.ModuleDict:
    """Return the networks by sensor; that of ``frozen`` is taken over and frozen, with its classifier in all others."""
    built = nn.ModuleDict({name: cast(nn.Module, networks.build(params, one)) for name, one in shapes.items()})
    if start:
        known = _reader(start, frozen).network
        for name, network in built.items():
            if name == frozen:
                network.load_state_dict(known.state_dict())
                network.requires_grad_(False)
            else:
                network.get_submodule("classifier").load_state_dict(known.classifier.state_dict())
                network.get_submodule("classifier").requires_grad_(False)
    return built


def _validation(history: Sequence[loop.Line], joint: bool) -> dict[str, Any]:
    """Return the epoch that each sensor's weights are of, and its accuracy there."""

    def chosen(sensor: str) -> loop.Line:
        of = list(history[0]["val"]) if joint else [sensor]
        return max(history, key=lambda line: (sum(line["val"][one]["accuracy"] for one in of), line["epoch"]))

    found = {sensor: chosen(sensor) for sensor in history[0]["val"]}
    return {
        "epoch": {sensor: line["epoch"] for sensor, line in found.items()},
        "accuracy": {sensor: line["val"][sensor]["accuracy"] for sensor, line in found.items()},
    }


def _network_baselines(trained: Classifier, known: BySensor, params: Params) -> bytes:
    """Return the mean-level baseline, and a readout of the networks' own latents fitted to shuffled labels."""
    found: dict[str, np.ndarray] = {}
    for place, (name, some) in enumerate(known.items()):
        latents = trained.readers[name].read(some.frames).latents
        assert latents is not None
        shuffled = np.random.default_rng([params.seed, 3, place]).permutation(some.materials)
        found |= readouts.stored(MEAN_LEVEL, name, Level.fit(some.frames, some.materials))
        found |= readouts.stored(PERMUTED_LABELS, name, Level.fit(latents[:, None], shuffled))
    return readouts.packed(found)
