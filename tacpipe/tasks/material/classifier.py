"""A trained classifier of materials, loaded from model files."""

from __future__ import annotations

import dataclasses
import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self, cast

import numpy as np
import torch

from tacpipe.arrays import Bools, Float32s, Floats, Int64s
from tacpipe.datasets import model_files
from tacpipe.datasets.dataset import Dataset
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.models.minirocket import MinirocketClassifier
from tacpipe.models.readout import Level, StatisticsClassifier
from tacpipe.models.recurrent_autoencoder import AutoencoderShape
from tacpipe.models.tensors import tensors_under
from tacpipe.models.transfer import Bands, Transfer
from tacpipe.plugins import params as params_of
from tacpipe.printable import plain
from tacpipe.scores import calibration
from tacpipe.tasks.material import networks
from tacpipe.tasks.material import slides as slides_of
from tacpipe.tasks.material.headline import Naming
from tacpipe.tasks.material.losses import CHUNK, Network
from tacpipe.tasks.material.params import MEAN_LEVEL, MaterialConfig, NetworkParams, Params
from tacpipe.tasks.material.sensor_calibration import CALIBRATION_FILE, unpack_calibrations
from tacpipe.tasks.material.slides import SlideLayout, Slides, describe_difference
from tacpipe.tasks.recordings import OpenedChain
from tacpipe.training.scaling import Affine

TASK = "material"
CHOSEN = ".chosen"  # suffix of the name of a readout's selection values, which may be NaN
MAX_FRAMES = 100_000  # maximum length of a slide
NEEDED = {
    **dict.fromkeys(("classes", "quantities"), list),
    **dict.fromkeys(("sensors", "params", "trained_on"), dict),
    "architecture": str,
}
CONFIG, WEIGHTS, LAST, BASELINES = "config.json", "model.safetensors", "last.safetensors", "baselines.safetensors"
UNKNOWN_ANSWER = "unknown"

ReadoutModel = MinirocketClassifier | StatisticsClassifier
Baseline = Level | ReadoutModel


@dataclass(frozen=True)
class ReaderOutput:
    """A reader's predictions for slides."""

    scores: Float32s  # (slide, class), in the order of the model's classes
    latents: Float32s | None  # (slide, latent)


class Reader(ABC):
    """Fitted model of one sensor."""

    GIVES_LIKELIHOODS: ClassVar[bool] = False  # True if the softmax of scores is a probability, possibly uncalibrated

    @property
    def any_length(self) -> bool:
        """Whether slides shorter than in training are accepted."""
        return False

    @abstractmethod
    def read(self, frames: Float32s) -> ReaderOutput:
        """Return scores, and latents if available, of slides (slide, time, channel) in device counts."""

    def scores_by(self, partner: Reader, latents: Float32s) -> Float32s:
        """Return the scores (slide, class) of latents by another sensor's classifier; requires a reader with latents."""
        return partner.scores_of(latents)

    def scores_of(self, latents: Float32s) -> Float32s:
        """Return the scores (slide, class) of latents, possibly of another sensor, by this sensor's classifier."""
        raise NotImplementedError


@dataclass(frozen=True)
class NetworkReader(Reader):
    """Network of one sensor and its input scaling."""

    GIVES_LIKELIHOODS: ClassVar[bool] = True
    network: Network
    scaling: Affine

    @property
    def any_length(self) -> bool:
        """Whether the network accepts slides shorter than in training."""
        return bool(getattr(self.network, "ANY_LENGTH", False))

    def read(self, frames: Float32s) -> ReaderOutput:
        """Return scores and latents of slides (slide, time, channel) in device counts."""
        scores, latents = [], []
        device = next(self.network.parameters()).device
        self.network.eval()
        with torch.no_grad():
            for first in range(0, len(frames), CHUNK):
                scaled = torch.from_numpy(self.scaling.apply(frames[first : first + CHUNK])).to(device)
                output = self.network(scaled.transpose(0, 1).contiguous(), decode=False)
                scores.append(output.scores.cpu().numpy())
                latents.append(output.latents.cpu().numpy())
        return ReaderOutput(np.concatenate(scores), np.concatenate(latents))

    def scores_of(self, latents: Float32s) -> Float32s:
        """Return the scores (slide, class) of latents, possibly of another sensor, by this sensor's classifier."""
        device = next(self.network.parameters()).device
        self.network.eval()
        with torch.no_grad():
            scores: Float32s = self.network.classify(torch.from_numpy(latents).to(device)).cpu().numpy()
        return scores


@dataclass(frozen=True)
class ReadoutReader(Reader):
    """Features and linear readout of one sensor."""

    fitted: ReadoutModel
    classes: tuple[int, ...]

    @property
    def any_length(self) -> bool:
        """Whether slides shorter than in training are accepted; true for statistics over time."""
        return self.fitted.ANY_LENGTH

    def read(self, frames: Float32s) -> ReaderOutput:
        """Return the readout's scores of slides (slide, time, channel) in device counts."""
        return ReaderOutput(expand_scores(self.fitted.scores(frames), self.fitted.classes, self.classes), None)


@dataclass(frozen=True)
class SpectraReader(Reader):
    """Spectra over spatial frequency of one sensor, and the classes that it and other sensors learned."""

    GIVES_LIKELIHOODS: ClassVar[bool] = True
    bands: Bands
    rate_hz: float
    speed_m_s: float
    transfer: Transfer
    classes: tuple[int, ...]

    def read(self, frames: Float32s) -> ReaderOutput:
        """Return log-likelihoods, and spectra as latents, of slides (slide, time, channel) in device counts."""
        spectra = self.bands.log_power(frames, self.rate_hz, self.speed_m_s).astype(np.float32)
        return ReaderOutput(
            expand_scores(self.transfer.learned.scores(spectra), self.transfer.classes, self.classes), spectra
        )

    def scores_by(self, partner: Reader, latents: Float32s) -> Float32s:
        """Return the scores (slide, class) of spectra by the classes learned from other sensors only."""
        return expand_scores(self.transfer.expected.scores(latents), self.transfer.classes, self.classes)


class Classifier:
    """Readers of one or more sensors that predict a slide's material; `model` adds the functions that read recordings."""

    def __init__(self, files: Mapping[str, bytes], chain: OpenedChain | None = None) -> None:
        """Build a classifier from a model's files; ``chain`` contains its preprocessing stages, None if they are unknown.

        Raises `TacpipeError` if a file is missing or invalid.
        """
        self.chain = chain  # preprocessing stages of the model; None if unknown
        config: MaterialConfig = model_files.tree(files, CONFIG, NEEDED)
        self.config = config
        self.params: Params = params_of.read(Params, config["params"], f"{CONFIG}, params")
        self.architecture: str = config["architecture"]
        self.classes: tuple[int, ...] = tuple(config["classes"])
        self.naming = Naming.from_json(config)
        self.quantities = tuple(config["quantities"])
        self.layouts = {name: SlideLayout.from_json(name, layout) for name, layout in config["sensors"].items()}
        stored = StoredClassifier(files, config, self.layouts, self.classes)
        self.readers: dict[str, Reader] = self.params.readers(stored)
        self.last: dict[str, Reader] = (
            self.params.readers(dataclasses.replace(stored, weights=LAST)) if LAST in files else {}
        )
        self.baselines: dict[str, dict[str, Baseline]] = {}
        if BASELINES in files:
            self.baselines = {MEAN_LEVEL: stored.baseline(MEAN_LEVEL, Level), **self.params.read_baselines(stored)}
        # Sensor -> calibration; empty unless `tacpipe calibrate` wrote the model
        self.calibrations = (
            unpack_calibrations(files[CALIBRATION_FILE], self.layouts) if CALIBRATION_FILE in files else {}
        )

    @classmethod
    def load(cls, files: Mapping[str, bytes], chain: OpenedChain | None = None) -> Self:
        """Return the classifier in a model's files. Raises `TacpipeError` if they are of another task.

        ``chain`` contains the model's preprocessing stages, as listed in its manifest. Without it `predict` cannot
        check that recordings passed through the same stages.
        """
        if CONFIG not in files:
            raise TacpipeError(
                "This is not a model: it has no config.json. Give the output of `tacpipe train material`."
            )
        task = model_files.tree(files, CONFIG).get("task")
        if task != TASK:
            task_name = plain(str(task))
            raise TacpipeError(
                f"This model is of the task {task_name}, not {TASK}. Give one of `tacpipe train material`."
            )
        with model_files.validated("the model"):
            classifier = cls(files, chain)
            classifier._check_parts()
        return classifier

    def _check_parts(self) -> None:
        """Read a slide of noise of each sensor, so that incompatible parts raise an error (mostly ``ValueError``)."""
        if not self.layouts or not self.classes or len({*self.classes}) != len(self.classes):
            raise ValueError(f"there are {len(self.layouts)} sensors and {len(self.classes)} classes")
        if self.naming.names and not set(self.classes) <= set(range(len(self.naming.names))):
            raise ValueError(f"there are {len(self.naming.names)} names for classes up to {max(self.classes)}")
        for name, layout in self.layouts.items():
            if not 0 < layout.frames <= MAX_FRAMES:
                raise ValueError(f"slides of {name} have {layout.frames} frames")
            noise = np.random.default_rng(0).normal(size=(2, layout.frames, len(layout.channels))).astype(np.float32)
            if self.baselines:
                self.baselines[MEAN_LEVEL][name].scores(noise)
            scores_by_reader = [reader[name].read(noise).scores for reader in (self.readers, self.last) if reader]
            shapes = [scores.shape for scores in scores_by_reader if not np.isnan(scores).any()] or [(0, 0)]
            if any(shape != (len(noise), len(self.classes)) for shape in shapes):
                raise ValueError(f"slides of {name} get scores of {shapes}, not of {len(self.classes)} classes")

    def probabilities(self, slides: Float32s | Floats, sensor: str = "") -> Float32s:
        """Return the probability of each class (slide, class), in the order of ``classes``: the softmax of `scores`.

        For a model from `tacpipe calibrate`, scores are first divided by the temperature, so that probabilities match
        observed frequencies. Networks are trained to output class probabilities. For ``spectra`` the result is the
        posterior under equal priors. Scores of ``minirocket`` and ``statistics`` are distances to class means without a
        fixed scale, so their softmax only ranks the classes. `predict` describes the arguments.
        """
        return self.probabilities_of(self.scores(slides, sensor), self._resolve_sensor(sensor))

    def probabilities_of(self, scores: Float32s, sensor: str) -> Float32s:
        """Return the probabilities (slide, class) for scores (slide, class) of a sensor's slides."""
        probabilities = (
            self.calibrations[sensor].probabilities(scores) if self.calibrations else calibration.probabilities(scores)
        )
        return probabilities.astype(np.float32)

    def answers(self, slides: Float32s | Floats, sensor: str = "") -> list[str]:
        """Return the class name of each slide, or ``unknown``, for a model from `tacpipe calibrate`.

        `predict` describes the arguments. Raises `UsageError` for an uncalibrated model.
        """
        frames = np.asarray(slides, np.float32)
        scores = self.scores(frames, sensor)
        return self.answers_from_scores(
            scores, frames[None] if frames.ndim == 2 else frames, self._resolve_sensor(sensor)
        )

    def answers_from_scores(self, scores: Float32s, frames: Float32s, sensor: str) -> list[str]:
        """Return the answers for slides (slide, time, channel) of a sensor, from their scores (slide, class).

        Raises `UsageError` if the model is not calibrated.
        """
        if not self.calibrations:
            raise UsageError(
                "The model has no calibrated probabilities and no answer unknown. Run `tacpipe calibrate MODEL DATASET "
                "--split SPLIT -o CALIBRATED` and give that one."
            )
        refused, names = self.is_unknown(scores, frames, sensor), self.naming.names_for(self.best_classes(scores))
        return [UNKNOWN_ANSWER if no else str(name) for no, name in zip(refused, names, strict=True)]

    def is_unknown(self, scores: Float32s, frames: Float32s, sensor: str) -> Bools:
        """Return a mask (slide,) of slides below the sensor's threshold of known classes; all False if uncalibrated."""
        sensor_calibration = self.calibrations.get(sensor)
        if sensor_calibration is None:
            return np.zeros(len(scores), dtype=bool)
        return sensor_calibration.score(scores, frames) < sensor_calibration.threshold

    def _resolve_sensor(self, sensor: str) -> str:
        """Return the sensor of slides: ``sensor`` or, if that is empty, the only one.

        Raises `UsageError` if there are several.
        """
        if not sensor and len(self.layouts) > 1:
            raise UsageError(
                f"The model knows the sensors {', '.join(self.layouts)}; name the one that recorded the slides."
            )
        return sensor or next(iter(self.layouts))

    def scores(self, slides: Float32s | Floats, sensor: str = "") -> Float32s:
        """Return the score of each class (slide, class), in the order of ``classes``; see `predict`.

        Raises `TacpipeError` for another shape, and if a value is not finite.
        """
        layout = self.layout(self._resolve_sensor(sensor))
        frames = np.asarray(slides, np.float32)
        frames = frames[None] if frames.ndim == 2 else frames
        shape = (layout.frames, len(layout.channels))
        if frames.ndim != 3 or frames.shape[1:] != shape:
            raise TacpipeError(f"Slides of {layout.sensor} are (slide, {shape[0]}, {shape[1]}), not {frames.shape}.")
        if not np.isfinite(frames).all():
            raise TacpipeError("A slide holds a value that is not finite; it must have a number in every frame.")
        return self.readers[layout.sensor].read(frames).scores

    def layout(self, sensor: str) -> SlideLayout:
        """Return the layout of a sensor's slides. Raises `TacpipeError` if the model has no such sensor."""
        if sensor not in self.layouts:
            raise TacpipeError(
                f"The model does not know the sensor {sensor}; it was trained on {', '.join(self.layouts)}. "
                f"Train one on recordings of it."
            )
        return self.layouts[sensor]

    def read(
        self, recordings: Dataset, *, labelled: bool = False, advance: Callable[..., None] | None = None
    ) -> dict[str, Slides]:
        """Return the slides of a dataset by sensor, with the channels of this model.

        Slides of other sensors are skipped if the model was trained for named sensors; otherwise they raise an error.
        ``labelled`` requires a label of each slide. ``advance`` is called after each slide. Raises `TacpipeError` as
        `tacpipe.tasks.material.slides.read`.
        """
        only = tuple(self.layouts) if self.params.sensors else ()
        present_sensors = {shard.attributes.get("sensor") for shard in recordings.recordings.values()}
        only = tuple(name for name in only if name in present_sensors) or only
        by_sensor = slides_of.read(
            recordings, only=only, quantities=self.quantities, naming=self.naming, labelled=labelled, advance=advance
        )
        for slides in by_sensor.values():
            self.check(slides)
        return by_sensor

    def check(self, slides: Slides) -> None:
        """Raise `TacpipeError` if the layout of slides differs from that of the training slides."""
        layout = self.layout(slides.layout.sensor)
        if not layout.is_compatible(slides.layout):
            raise TacpipeError(
                f"{slides.names[0]} {describe_difference(layout, slides.layout)} as the model was trained on. "
                f"Segment it with the same params, or train on slides like it."
            )

    def best_classes(self, scores: Float32s) -> Int64s:
        """Return the class number with the highest score of each slide (slide,)."""
        best: Int64s = np.array(self.classes, np.int64)[scores.argmax(axis=1)]
        return best

    @property
    def names(self) -> tuple[str, ...]:
        """Names of ``classes``, as in the labels of recordings."""
        return tuple(map(self.naming.name, self.classes))

    def partner(self, sensor: str) -> str:
        """Return the sensor whose classifier is exchanged with that of ``sensor``: the next one."""
        names = list(self.layouts)
        return names[(names.index(sensor) + 1) % len(names)]


@dataclass(frozen=True)
class StoredClassifier:
    """Files of a classifier, and the loaders that the task offers to architectures."""

    files: Mapping[str, bytes]
    config: MaterialConfig
    layouts: Mapping[str, SlideLayout]
    classes: tuple[int, ...]
    weights: str = WEIGHTS  # name of the file with the weights of networks and readouts

    def readouts(self, kind: type[ReadoutModel]) -> dict[str, Reader]:
        """Return the features with linear readouts by sensor."""
        arrays = model_files.arrays(self.files[self.weights], self.weights, but=CHOSEN)
        return {
            name: ReadoutReader(kind.from_tensors(tensors_under(f"{name}.", arrays)), self.classes)
            for name in self.layouts
        }

    def spectra(self) -> dict[str, Reader]:
        """Return the spectra over spatial frequency by sensor."""
        arrays, stored = model_files.arrays(self.files[self.weights], self.weights), self.config["spectra"]
        bands = Bands(stored["way_m"], np.array(stored["edges_per_m"]))
        return {
            name: SpectraReader(
                bands,
                layout.rate_hz,
                stored["speed_m_s"][name],
                Transfer.from_tensors(tensors_under(f"{name}.", arrays)),
                self.classes,
            )
            for name, layout in self.layouts.items()
        }

    def networks(self, params: NetworkParams) -> dict[str, Reader]:
        """Return the networks by sensor, built by ``params``."""
        tensors = model_files.tensors(self.files[self.weights], self.weights)
        readers: dict[str, Reader] = {}
        for name in self.layouts:
            shape = AutoencoderShape(**self.config["shapes"][name])
            weights = tensors_under(f"{name}.", tensors)
            network = model_files.build_with_weights(functools.partial(networks.build_network, params, shape), weights)
            scaling = {key: np.array(value) for key, value in self.config["scaling"][name].items()}
            readers[name] = NetworkReader(cast(Network, network), Affine.from_tensors(scaling))
        return readers

    def baseline(self, name: str, kind: type[Level | ReadoutModel]) -> dict[str, Baseline]:
        """Return a stored baseline by sensor."""
        arrays = model_files.arrays(self.files[BASELINES], BASELINES, but=CHOSEN)
        return {sensor: kind.from_tensors(tensors_under(f"{name}.{sensor}.", arrays)) for sensor in self.layouts}


def expand_scores(scores: Float32s, scored_classes: Any, classes: tuple[int, ...]) -> Float32s:
    """Return scores of ``scored_classes`` as columns of all ``classes``, with -inf for classes without a score.

    >>> expand_scores(np.array([[1.0, 2.0]], np.float32), [3, 5], (3, 4, 5)).tolist()
    [[1.0, -inf, 2.0]]
    """
    spread_scores = np.full((len(scores), len(classes)), -np.inf, np.float32)
    spread_scores[:, [classes.index(int(number)) for number in scored_classes]] = scores
    return spread_scores
