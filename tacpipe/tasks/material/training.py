"""Train a classifier of materials: from slides and params to the files of a model."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.plugins import params as params_of
from tacpipe.plugins.constraints import CommaList
from tacpipe.tasks.material import held_out, network_training, readouts
from tacpipe.tasks.material import slides as slides_of
from tacpipe.tasks.material.classifier import ROCKET, STATISTICS, TASK, Config
from tacpipe.tasks.material.naming import Naming
from tacpipe.tasks.material.network_training import RAEC
from tacpipe.tasks.material.params import Estimator, Minirocket, Params, Raec, Spectra, Statistics
from tacpipe.tasks.material.params import Network as NetworkParams
from tacpipe.tasks.material.slides import BySensor

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

# that are read where params name none
QUANTITIES = dict.fromkeys((ROCKET, STATISTICS), (slides_of.TACTILE, "vibration"))


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
    kinds = slides_of.quantities(params.quantities) or QUANTITIES.get(params.architecture, (slides_of.TACTILE,))
    naming = _naming(params.label, training, validation)
    known = slides_of.read(training, only=only, quantities=kinds, naming=naming, labelled=True)
    watched: BySensor = {}
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
        return readouts.spectra(
            params, config, known, watched, held_out.materials(params.hold_out, classes, known, naming)
        )
    if isinstance(params, Estimator):
        return readouts.estimators(params, config, known, watched)
    if isinstance(params, NetworkParams):
        return network_training.train(params, config, known, watched, workspace, init)
    raise TacpipeError(
        f"The params of the architecture {params.architecture} extend neither Estimator nor Network of "
        f"tacpipe.tasks.material.params, so the task cannot train it."
    )


def _naming(key: str, *parts: Dataset | None) -> Naming:
    """Return the naming of the labels ``key`` of all recordings to learn from or to choose by."""
    every = [shard for part in parts if part is not None for shard in part.recordings.values()]
    return Naming.from_labels(key, (shard.attributes.get(key) for shard in every))


def _check(params: Params, init: Mapping[str, bytes] | None) -> None:
    """Refuse a model to begin with where nothing is learned from it, and a frozen sensor without one."""
    if init is not None and not isinstance(params, Raec):
        raise UsageError(
            f"--init goes with the architecture {RAEC} alone, whose networks can be aligned to that of a frozen sensor, "
            f"not with {params.architecture}. Leave it out, or choose --architecture {RAEC}."
        )
    if bool(network_training.frozen(params)) != (init is not None):
        raise UsageError(
            "Alignment to a trained network needs both --frozen-sensor, the sensor that it is of, and --init, the model "
            "that holds it."
        )
