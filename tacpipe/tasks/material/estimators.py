"""Check the estimators and networks that architectures build, and store scikit-learn estimators without pickle.

A skops file is a zip archive of a JSON description and arrays. It is written so that equal estimators have equal bytes.
It is loaded only if each of its types is validated by skops (most of scikit-learn, numpy and scipy), belongs to the
architecture's package, which is installed code, or is listed by the architecture.
"""

from __future__ import annotations

import io
import json
import pkgutil
import zipfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Self, cast

import numpy as np
import torch
from torch import Tensor, nn

from tacpipe.arrays import Float32s, Floats, Int64s
from tacpipe.errors import TacpipeError
from tacpipe.models.recurrent_autoencoder import AutoencoderShape, PlainClassifier
from tacpipe.models.tensors import require_network, require_output
from tacpipe.plugins import extras
from tacpipe.printable import listed, plain
from tacpipe.tasks.material.losses import Network
from tacpipe.tasks.material.params import Estimator, NetworkParams

SCHEMA = "schema.json"
MODIFICATION_TIME = (1980, 1, 1, 0, 0, 0)  # modification time of all archive members
TRIAL_SLIDES = 2  # number of slides for a trial
MIN_PROBABILITY = 1e-12  # lower bound of probabilities before the logarithm
MAX_UNPACKED_BYTES = 2**31  # maximum unpacked size of a file


@dataclass(frozen=True)
class FittedEstimator:
    """A fitted estimator and the definition of its features."""

    estimator: Any
    features: Callable[[Float32s], Float32s]

    @classmethod
    def fit(cls, params: Estimator, frames: Float32s, materials: Int64s) -> Self:
        """Return the estimator of ``params``, fitted on slides (slide, time, channel) with classes (slide,).

        Raises `TacpipeError` if features or scores do not have the form required by `Estimator`.
        """
        fitted = cls(params.build(params.seed), params.features)
        fitted.estimator.fit(fitted._features(frames), materials)
        fitted.scores(frames[:TRIAL_SLIDES])
        return fitted

    @property
    def classes(self) -> tuple[int, ...]:
        """Classes that it scores, in order."""
        return tuple(int(number) for number in self.estimator.classes_)

    def scores(self, frames: Float32s) -> Float32s:
        """Return the score of each class (slide, class) for slides (slide, time, channel).

        Probabilities are converted to logarithms, so that their softmax restores them. Raises `TacpipeError` for
        another shape.
        """
        features = self._features(frames)
        if hasattr(self.estimator, "predict_proba"):
            values: Floats = np.log(np.clip(self.estimator.predict_proba(features), MIN_PROBABILITY, None))
        else:
            values = np.asarray(self.estimator.decision_function(features))
            values = np.stack([-values, values], axis=1) / 2 if values.ndim == 1 else values  # two classes
        if values.shape != (len(frames), len(self.classes)):
            raise TacpipeError(
                f"{type(self.estimator).__name__} returns scores {values.shape} for {len(frames)} slides and "
                f"{len(self.classes)} classes; they must be (slide, class)."
            )
        return values.astype(np.float32)

    def _features(self, frames: Float32s) -> Float32s:
        """Return the features of slides (slide, feature).

        Raises `TacpipeError` for another shape, or values that are not finite.
        """
        features: Float32s = np.asarray(self.features(frames), np.float32)
        if features.ndim != 2 or len(features) != len(frames) or not np.isfinite(features).all():
            state = (
                "are not all finite" if features.ndim == 2 and len(features) == len(frames) else f"are {features.shape}"
            )
            raise TacpipeError(
                f"The features of {len(frames)} slides {state}; features(frames) must return (slide, feature), all finite."
            )
        return features


def pack_estimators(fitted: Mapping[str, FittedEstimator], params: Estimator) -> bytes:
    """Return the file content of fitted estimators by sensor. Raises `TacpipeError` if it could not be read back."""
    with extras.explain_missing(f"The architecture {params.architecture}"):
        from skops.io import dumps, get_untrusted_types
        from skops.io.exceptions import UnsupportedTypeException
    try:
        content = dumps({sensor: sensor_estimator.estimator for sensor, sensor_estimator in fitted.items()})
    except UnsupportedTypeException as error:
        raise TacpipeError(
            f"The estimator of {params.architecture} cannot be stored without pickle ({plain(str(error), 200)}). Build it "
            f"of estimators of scikit-learn, with functions of a module and not lambda."
        ) from error
    if refused := _untrusted_types(get_untrusted_types(data=content), params):
        raise TacpipeError(
            f"The estimator of {params.architecture} holds {refused}, which skops does not validate when it is read. Name "
            f"what you trust in TRUSTED of {type(params).__name__}, or build another estimator."
        )
    return _make_reproducible(content)


def unpack_estimators(content: bytes, name: str, params: Estimator) -> dict[str, FittedEstimator]:
    """Return the estimators by sensor in the file ``name``.

    Raises `TacpipeError` if it is not a skops file, or has types that the architecture does not trust.
    """
    with extras.explain_missing(f"The architecture {params.architecture}"):
        from skops.io import get_untrusted_types, loads
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as file:
            if sum(member.file_size for member in file.infolist()) > MAX_UNPACKED_BYTES:
                raise TacpipeError(f"{name} unpacks to more than {MAX_UNPACKED_BYTES >> 30} GiB, so it is not read.")
        untrusted_types = get_untrusted_types(data=content)
        if refused := _untrusted_types(untrusted_types, params):
            raise TacpipeError(
                f"{name} holds {refused}, which the architecture {params.architecture} does not trust. Train the "
                f"model again."
            )
        estimators = loads(content, trusted=untrusted_types)
        return {sensor: FittedEstimator(estimator, params.features) for sensor, estimator in estimators.items()}
    except TacpipeError:
        raise
    except Exception as error:  # a damaged file raises errors of many types
        raise TacpipeError(
            f"{name} is not a file of skops that can be read ({plain(' '.join(str(error).split()), 200)}). Copy it again "
            f"from its source."
        ) from error


def _untrusted_types(types: Iterable[str], params: Estimator) -> str:
    """Return, as text, the types that are neither in the architecture's package nor trusted by it."""
    package = type(params).__module__.partition(".")[0]
    foreign = [name for name in types if name not in params.TRUSTED and not _is_defined_in(package, name)]
    return listed([plain(name, 100) for name in foreign]) if foreign else ""


def _is_defined_in(package: str, name: str) -> bool:
    """Return whether a type or function is defined in a package, rather than imported by one of its modules.

    Without this check a file could refer to any name in a module, e.g. ``package.module.run`` after
    ``from subprocess import run``.
    """
    if name.partition(".")[0] != package:
        return False
    try:
        module = getattr(pkgutil.resolve_name(name), "__module__", None)
    except (ImportError, AttributeError, ValueError):
        return False
    return isinstance(module, str) and module.partition(".")[0] == package


def _make_reproducible(content: bytes) -> bytes:
    """Return a skops file without times and with sequential numbers for memory addresses, so that it is reproducible."""
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        members = {member: file.read(member) for member in file.namelist()}
    numbers: dict[Any, int] = {}
    description = _renumber(json.loads(members[SCHEMA]), numbers)
    renamed = {SCHEMA: json.dumps(description, indent=1, sort_keys=True).encode()}
    renamed |= {_renumber_file_name(member, numbers): data for member, data in members.items() if member != SCHEMA}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as file:
        for member, data in sorted(renamed.items()):
            info = zipfile.ZipInfo(member, MODIFICATION_TIME)
            info.compress_type = zipfile.ZIP_DEFLATED
            file.writestr(info, data)
    return buffer.getvalue()


def _renumber(node: Any, numbers: dict[Any, int]) -> Any:
    """Return a description with ``__id__`` numbered from 1 in order of occurrence, and the file names to match.

    ``numbers`` maps the earlier ids to the numbers, and is extended.
    """
    if isinstance(node, list):
        return [_renumber(child, numbers) for child in node]
    if not isinstance(node, Mapping):
        return node
    renumbered: dict[str, Any] = {}
    for name, value in node.items():
        if name == "__id__":
            renumbered[name] = numbers.setdefault(value, len(numbers) + 1)
        elif name == "file":
            renumbered[name] = _renumber_file_name(value, numbers)
        else:
            renumbered[name] = _renumber(value, numbers)
    return renumbered


def _renumber_file_name(name: str, numbers: dict[Any, int]) -> str:
    """Return a member's name with its number instead of the memory address from skops."""
    stem, dot, ending = name.partition(".")
    return f"{numbers.setdefault(int(stem), len(numbers) + 1)}{dot}{ending}" if stem.isdigit() else name


def build_network(params: NetworkParams, shape: AutoencoderShape) -> Network:
    """Return the network of ``params`` for a sensor, with random weights.

    A plain network is wrapped in the common interface.

    Raises `TacpipeError` if the params build anything else.
    """
    network = require_network(params.build(shape), params.architecture)
    return cast(Network, network if hasattr(network, "classify") else PlainClassifier(network))


@torch.no_grad()
def check_network(network: nn.Module, params: NetworkParams, slides: Tensor, classes: int) -> None:
    """Raise `TacpipeError` if a network does not return scores for ``slides`` (slide, time, channel)."""
    training = network.training
    output = network.eval()(slides[:TRIAL_SLIDES].transpose(0, 1).contiguous(), decode=False)
    network.train(training)
    scores, shape = getattr(output, "scores", None), (len(slides[:TRIAL_SLIDES]), classes)
    require_output(scores, shape, params.architecture, f"{shape[0]} slides", "scores (slide, class)")
