"""Train a classifier of materials: from slides and params to the files of a model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.plugins import params as params_of
from tacpipe.plugins.constraints import CommaList
from tacpipe.tasks import trained_on
from tacpipe.tasks.material import network_training, readouts
from tacpipe.tasks.material import slides as slides_of
from tacpipe.tasks.material.classifier import TASK, Config
from tacpipe.tasks.material.naming import Naming
from tacpipe.tasks.material.params import (
    Estimator,
    Minirocket,
    NetworkParams,
    Params,
    Spectra,
    Statistics,
    aligning_architectures,
)
from tacpipe.tasks.material.slides import BySensor

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset


@dataclass(frozen=True)
class TrainingSlides:
    """The slides and settings that an architecture's ``fit`` learns from, and the ways to train that the task offers."""

    config: Config  # the model's configuration as far as the data determine it
    training: BySensor
    validation: BySensor
    naming: Naming
    workspace: Path  # folder of the checkpoints of an interrupted training
    init: Mapping[str, bytes] | None  # the files of the model of ``--init``

    def fit_rockets(self, params: Minirocket) -> dict[str, bytes]:
        """Return the files of random convolutions and a readout for each sensor."""
        return readouts.rockets(params, self.config, self.training, self.validation)

    def fit_statistics(self, params: Statistics) -> dict[str, bytes]:
        """Return the files of statistics and a readout for each sensor."""
        return readouts.statistics(params, self.config, self.training, self.validation)

    def fit_spectra(self, params: Spectra) -> dict[str, bytes]:
        """Return the files of spectra, by which sensors learn materials from one another."""
        excluded = slides_of.held_out_materials(params.hold_out, self.config["classes"], self.training, self.naming)
        return readouts.spectra(params, self.config, self.training, self.validation, excluded)

    def fit_estimators(self, params: Estimator) -> dict[str, bytes]:
        """Return the files of one fitted estimator of scikit-learn per sensor."""
        return readouts.estimators(params, self.config, self.training, self.validation)

    def train_networks(self, params: NetworkParams) -> dict[str, bytes]:
        """Return the files of one network per sensor, trained by the shared loop."""
        return network_training.train(params, self.config, self.training, self.validation, self.workspace, self.init)


def train(
    params: Params,
    training: Dataset,
    validation: Dataset | None,
    workspace: Path,
    init: Mapping[str, bytes] | None = None,
) -> dict[str, bytes]:
    """Return the files of a model trained on the slides of ``training`` and, for networks, chosen on ``validation``.

    Whatever is fitted is fitted on training slides alone; a readout in closed form needs none to choose by, and learns
    from validation slides too where ``use_validation`` is set.
    Raises `TacpipeError` where slides lack labels, differ in layout or, learned jointly, in materials.
    """
    _check(params, init)
    only = CommaList().items(params.sensors)
    kinds = slides_of.quantities(params.quantities) or params.QUANTITIES
    naming = _naming(params.label, training, validation)
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
    config: Config = {
        "task": TASK,
        "architecture": params.architecture,
        "params": params_of.to_json(params),
        "split": params.run_label,
        "quantities": kinds,
        "sensors": {name: slides.layout.to_json() for name, slides in training_slides.items()},
        "classes": classes,
        **naming.to_json(),
        **({"absent": absent} if absent else {}),
        "counts": {
            role: {name: len(slides) for name, slides in part.items()}
            for role, part in (("train", training_slides), ("val", validation_slides))
        },
        "trained_on": trained_on.merge(
            *(
                zip(slides.names, slides.digests, strict=True)
                for part in (training_slides, validation_slides)
                for slides in part.values()
            )
        ),
    }
    return params.fit(TrainingSlides(config, training_slides, validation_slides, naming, workspace, init))


def _naming(key: str, *parts: Dataset | None) -> Naming:
    """Return the naming of the labels ``key`` of all recordings to learn from or to choose by."""
    shards = [shard for part in parts if part is not None for shard in part.recordings.values()]
    return Naming.from_labels(key, (shard.attributes.get(key) for shard in shards))


def _check(params: Params, init: Mapping[str, bytes] | None) -> None:
    """Refuse a model to begin with where nothing is learned from it, and a frozen sensor without one."""
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
