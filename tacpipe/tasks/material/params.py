"""Params of `tacpipe train material`, which define how a classifier is built and trained; one class per architecture.

Classes of other packages extend `NetworkParams`, whose method `build` defines the inputs and outputs of a network.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NotRequired, TypedDict

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io import Scalar
from tacpipe.plugins import architectures, fields
from tacpipe.plugins.constraints import (
    Assignments,
    CommaList,
    Dropout,
    Names,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    Range,
    Seed,
    StoredAs,
)
from tacpipe.plugins.params import Panels, added
from tacpipe.plugins.stage import Presets
from tacpipe.tasks.task import ModelConfig
from tacpipe.training.devices import Precision

if TYPE_CHECKING:
    from torch import nn

    from tacpipe.models.recurrent_autoencoder import AutoencoderShape
    from tacpipe.tasks.material.classifier import Baseline, Reader, ReadoutModel, StoredClassifier
    from tacpipe.tasks.material.losses import Weights
    from tacpipe.tasks.material.network_training import TrainingSlides

MEAN_LEVEL, PERMUTED_LABELS = "mean_level", "permuted_labels"  # baselines of all architectures
KEY = "material"  # default label key of classes
# from the paper's text; its code has no header for BioTac, and PyTorch ignores its dropout in a single-layer LSTM
_PAPER_TEXT: Mapping[str, Scalar] = {"epochs": 2000, "dropout": 0.2, "headers": "other=mlp"}
_ALIGNED_RECONSTRUCTION = 0.05  # weight for networks aligned to a frozen one, from the published script
HeldOut = Annotated[str, Assignments(Annotated[str, CommaList(min_items=1)], between=";")]


@dataclass(frozen=True)
class MaterialModelParams(ABC):
    """Params of all classifiers of materials."""

    ARCHITECTURES: ClassVar[str] = "material"  # name of the task in entry points
    TITLE: ClassVar[str] = ""  # name in reports; empty: the architecture
    QUANTITIES: ClassVar[tuple[str, ...]] = ("tactile",)  # default of the param ``quantities``
    ALIGNS_SENSORS: ClassVar[bool] = False  # True if networks can be aligned to the frozen one of the --init model
    architecture: str = "minirocket"
    sensors: Names = ""  # sensors to train on; empty: all
    # quantities to read; empty: tactile, and for minirocket and statistics also vibration (22 readings per frame)
    quantities: Names = ""
    # label of this run in a report, next to others of the same method, as blocked
    run_label: Annotated[str, StoredAs("setting")] = ""
    seed: Seed = 0  # random seed of kernels, initial weights, the order of slides and pairs
    # label that contains the class of a recording, a whole number or any text
    label: str = added(KEY)
    # also fit the mean-level and shuffled-label baselines, with which evaluate compares the model
    baselines: bool = True
    # labels to learn; permuted: those of the training slides in random order, a negative control
    labels: Literal["true", "permuted"] = "true"
    PANELS: ClassVar[Panels] = {
        "Model": (
            *("architecture", "features", "headers", "hidden", "latents", "decoder", "unpool"),
            *("dropout", "scaling", "joint", "frozen_sensor"),
        ),
        "Training": (
            *("reconstruction_weight", "classification_weight", "alignment_weight", "alignment_loss", "align_from"),
            *("epochs", "batch", "learning_rate", "cycle", "patience", "shuffle", "drop_last", "select"),
            *("precision", "seed", "baselines"),
        ),
        "Data": (
            *("label", "sensors", "quantities", "labels", "hold_out", "speeds", "use_validation", "pairing"),
            *("subsample_sensor", "subsample_percent", "run_label"),
        ),
    }

    @property
    def aligned_sensor(self) -> str:
        """Sensor of the ``--init`` model whose network stays frozen; empty if there is none."""
        return ""

    @abstractmethod
    def fit(self, slides: TrainingSlides) -> dict[str, bytes]:
        """Return the files of a model trained on ``slides``: ``config.json`` and the classifier's parameters.

        `NetworkParams` implements it for the networks that an architecture builds.
        """

    def readers(self, stored: StoredClassifier) -> dict[str, Reader]:
        """Return the fitted reader of each sensor. `NetworkParams` implements it.

        Raises `TacpipeError` if the architecture lacks it.
        """
        raise TacpipeError(f"The architecture {self.architecture} has no method readers, so its models cannot be used.")

    def read_baselines(self, stored: StoredClassifier) -> dict[str, dict[str, Baseline]]:
        """Return the stored baselines by name and sensor, without the mean level."""
        from tacpipe.models.readout import Level

        return {PERMUTED_LABELS: stored.baseline(PERMUTED_LABELS, Level)}


@dataclass(frozen=True)
class ReadoutParams(MaterialModelParams, ABC):
    """A linear readout of features per sensor, fitted in closed form."""

    QUANTITIES: ClassVar[tuple[str, ...]] = ("tactile", "vibration")
    VIEWS: ClassVar[Mapping[str, str]] = {}  # further baselines, and the part of slides that they read
    use_validation: bool = True  # also train on validation slides; nothing is chosen by them

    @property
    @abstractmethod
    def model(self) -> type[ReadoutModel]:
        """The class of the classifier."""

    @property
    def settings(self) -> Mapping[str, Any]:
        """The settings of its ``fit``."""
        return {}

    def fit(self, slides: TrainingSlides) -> dict[str, bytes]:
        """Return the files of features and a readout for each sensor."""
        return slides.fit_readouts(self)

    def readers(self, stored: StoredClassifier) -> dict[str, Reader]:
        """Return features and a readout by sensor."""
        return stored.readouts(self.model)

    def read_baselines(self, stored: StoredClassifier) -> dict[str, dict[str, Baseline]]:
        """Return the same model fitted to shuffled labels, and to the `VIEWS` of slides."""
        return {name: stored.baseline(name, self.model) for name in (PERMUTED_LABELS, *self.VIEWS)}


@dataclass(frozen=True)
class Minirocket(ReadoutParams):
    """Random convolutions and a linear readout per sensor: our most accurate classifier."""

    # classifier: minirocket, random convolutions and a linear readout
    architecture: Literal["minirocket"] = "minirocket"
    TITLE: ClassVar[str] = "MiniRocket"
    features: Annotated[int, Range(84)] = 10_000  # features of each sensor
    PRESETS: ClassVar[Presets] = {"quick": {"features": 1_000}}

    @property
    def model(self) -> type[ReadoutModel]:
        """The class of the classifier."""
        from tacpipe.models.minirocket import MinirocketClassifier

        return MinirocketClassifier

    @property
    def settings(self) -> Mapping[str, Any]:
        """Random seed and number of the patterns."""
        return {"seed": self.seed, "features": self.features}


@dataclass(frozen=True)
class Statistics(ReadoutParams):
    """Statistics of each channel and a linear readout per sensor, for sensors with few slides."""

    # statistics: statistics of each channel and a linear readout, for few slides
    architecture: Literal["statistics"] = "statistics"
    VIEWS: ClassVar[Mapping[str, str]] = {"level_only": "level", "level_removed": "level_removed"}

    @property
    def model(self) -> type[ReadoutModel]:
        """The class of the classifier."""
        from tacpipe.models.readout import StatisticsClassifier

        return StatisticsClassifier


@dataclass(frozen=True)
class Spectra(MaterialModelParams):
    """Spectra over spatial frequency, through which sensors learn materials from each other."""

    # spectra: power over spatial frequency
    architecture: Literal["spectra"] = "spectra"
    TITLE: ClassVar[str] = "spatial spectra"
    use_validation: bool = True  # also train on validation slides; nothing is chosen by them
    hold_out: HeldOut = ""  # materials whose labels a sensor does not learn, as roboskin=17,18,19,20
    # metres per second of slides whose recordings have no speed
    speeds: Annotated[str, Assignments(PositiveFloat)] = "biotac=0.025,roboskin=0.05"

    def fit(self, slides: TrainingSlides) -> dict[str, bytes]:
        """Return the files of spectra, through which sensors learn materials from each other."""
        return slides.fit_spectra(self)

    def readers(self, stored: StoredClassifier) -> dict[str, Reader]:
        """Return spectra by sensor."""
        return stored.spectra()


@dataclass(frozen=True)
class NetworkParams(MaterialModelParams, ABC):
    """Params of all networks for slides; base class for architectures."""

    hold_out: HeldOut = ""  # materials whose labels a sensor does not learn, as roboskin=17,18,19,20
    # sensor that learns from only a part of the batches; needs --no-shuffle
    subsample_sensor: Annotated[str, StoredAs("reduce")] = ""
    # percentage of the batches that this sensor learns from
    subsample_percent: Annotated[Literal[100, 90, 50, 25, 17, 11], StoredAs("ratio")] = 100
    # network before a sensor's LSTM, such as biotac=mlp, or other=mlp for all sensors without a 6 x 10 grid; by default
    # cnn for such a grid, else none
    headers: Annotated[str, Assignments(Literal["none", "mlp", "cnn"])] = ""
    hidden: PositiveInt = 90  # units of each LSTM
    # scaling of the input: none; standard: mean 0 and deviation 1 of each channel; spread: one deviation for all channels,
    # zero stays zero; log: spread of log(1 + x)
    scaling: Literal["none", "standard", "spread", "log"] = "none"
    epochs: PositiveInt = 300  # maximum number of passes over the training slides
    batch: PositiveInt = 32  # slides of each sensor per step of the optimiser
    learning_rate: PositiveFloat = 5e-4  # learning rate of Adam
    cycle: bool = False  # raise and lower the learning rate once over all epochs
    patience: NonNegativeInt = 0  # epochs without a better validation accuracy after which training ends; 0: all epochs
    shuffle: bool = True  # draw new batches in every epoch
    drop_last: bool = False  # omit the last incomplete batch, also in evaluation, as the published code does
    # weights to keep: best, of the highest validation accuracy; last, of the last epoch
    select: Literal["best", "last"] = "best"
    # precision of products in training; bfloat16 takes half the memory and rounds to 3 digits, weights stay in float32
    precision: Precision = added("float32")

    def fit(self, slides: TrainingSlides) -> dict[str, bytes]:
        """Return the files of one network per sensor, trained by the shared loop."""
        return slides.train_networks(self)

    def readers(self, stored: StoredClassifier) -> dict[str, Reader]:
        """Return the networks by sensor."""
        return stored.networks(self)

    @property
    def learns_jointly(self) -> bool:
        """Whether the latents of different sensors are aligned."""
        return False

    @property
    def pairing_method(self) -> Literal["random", "fixed", "permuted"]:
        """How slides of different sensors are paired."""
        return "random"

    def shape(self, channels: int, header: str, classes: int) -> AutoencoderShape:
        """Return the sizes of a sensor's network."""
        from tacpipe.models.recurrent_autoencoder import AutoencoderShape

        return AutoencoderShape(channels=channels, classes=classes, header=header, hidden=self.hidden)

    def loss_weights(self, *, joint: bool) -> Weights:
        """Return the loss weights; ``joint`` is True if several sensors are trained."""
        from tacpipe.tasks.material.losses import Weights

        return Weights(alignment=0.0)

    @abstractmethod
    def build(self, shape: AutoencoderShape) -> nn.Module:
        """Return a sensor's network with random weights (`tacpipe.models.recurrent_autoencoder.AutoencoderShape`).

        **A plain network** is called with slides (time, slide, ``shape.channels``), float32, scaled as selected by
        ``scaling``, and returns scores (slide, ``shape.classes``). Training minimises the negative log-likelihood of
        their softmax.

        **A network with a method ``classify``** returns a `tacpipe.models.recurrent_autoencoder.NetworkOutput`
        (latents, scores, and reconstructed frames or None), accepts ``decode=False``, and has ``classify(latents)``,
        which returns scores. The latents of sensors can then be compared.

        In both cases the result for a slide must not depend on other slides.

        The task reads and scales slides, trains (Adam, epochs selected by validation accuracy, resumable checkpoints,
        bfloat16), stores weights as safetensors, fits the baselines and permuted labels, and evaluates.
        """

    def check(self) -> None:
        """Raise `UsageError` for a subsampled sensor with shuffled batches, and for a percentage without a sensor."""
        if self.subsample_sensor and self.shuffle:
            raise UsageError(
                f"subsample_sensor is {self.subsample_sensor} and batches are shuffled, so that this sensor would learn "
                f"from all slides over the epochs; give --no-shuffle with --subsample-sensor."
            )
        if self.subsample_percent != 100 and not self.subsample_sensor:
            raise UsageError(
                f"subsample_percent is {self.subsample_percent} and no sensor is subsampled; name one with "
                f"--subsample-sensor."
            )


@dataclass(frozen=True)
class Raec(NetworkParams):
    """The paper's recurrent autoencoder with a classifier, trained jointly for different sensors or separately."""

    # raec: the recurrent autoencoder of the paper
    architecture: Literal["raec"] = "raec"
    TITLE: ClassVar[str] = "RAEC"
    ALIGNS_SENSORS: ClassVar[bool] = True
    joint: bool = True  # align the latents of different sensors on slides of the same material
    # sensor of the --init model whose network is frozen; the latents of the others are aligned to its own
    frozen_sensor: Annotated[str, StoredAs("known")] = ""
    # pairs of joint learning: random; fixed: drawn once; permuted: of other materials, a negative control
    pairing: Literal["random", "fixed", "permuted"] = "random"
    # alignment loss: pairs of one material, or contrast with all other slides too
    alignment_loss: Annotated[Literal["pairs", "contrast"], StoredAs("agreement")] = "pairs"
    # D1: latents are the decoder's first state; D2: they are its input at every step
    decoder: Literal["D1", "D2"] = "D1"
    latents: PositiveInt = 40  # number of values that represent a slide
    # how the pooling of a cnn is reversed: nearest; last, with the last frame's indices, as published
    unpool: Literal["nearest", "last"] = "nearest"
    reconstruction_weight: NonNegativeFloat = 0.01  # weight of the squared error of reconstructed slides
    classification_weight: NonNegativeFloat = 1.0  # weight of the negative log-likelihood of classes
    alignment_weight: NonNegativeFloat = 1.0  # weight of the alignment loss between sensors
    align_from: NonNegativeInt = 20  # first epoch, from 0, in which latents are aligned
    # dropout of latents in training; 0 as in the published code, 0.2 in the paper's text
    dropout: Dropout = 0.0
    PRESETS: ClassVar[Presets] = {
        "paper": _PAPER_TEXT,
        "authors": {  # the published code with its quirks, for slides of the layout authors
            "epochs": 2000,
            "pairing": "fixed",
            "shuffle": False,
            "drop_last": True,
            "unpool": "last",
            "select": "last",
            "seed": 1,
        },
        "quick": {"epochs": 30},
    }

    @property
    def aligned_sensor(self) -> str:
        """Sensor of the ``--init`` model whose network stays frozen; empty if there is none."""
        return self.frozen_sensor

    @property
    def learns_jointly(self) -> bool:
        """Whether the latents of different sensors are aligned."""
        return self.joint

    @property
    def pairing_method(self) -> Literal["random", "fixed", "permuted"]:
        """How slides of different sensors are paired."""
        return self.pairing

    def shape(self, channels: int, header: str, classes: int) -> AutoencoderShape:
        """Return the sizes of a sensor's network for its numbers of channels and classes, with this ``header``."""
        return dataclasses.replace(
            super().shape(channels, header, classes),
            decoder=self.decoder,
            latents=self.latents,
            unpool=self.unpool,
            dropout=self.dropout,
        )

    def loss_weights(self, *, joint: bool) -> Weights:
        """Return the loss weights; ``joint`` is True if several sensors are trained."""
        from tacpipe.tasks.material.losses import Weights

        return Weights(
            reconstruction=_ALIGNED_RECONSTRUCTION if self.frozen_sensor else self.reconstruction_weight,
            classification=self.classification_weight,
            alignment=self.alignment_weight if joint else 0.0,
            align_from=self.align_from,
            alignment_loss=self.alignment_loss,
        )

    def build(self, shape: AutoencoderShape) -> nn.Module:
        """Return the paper's autoencoder with a classifier."""
        from tacpipe.models.recurrent_autoencoder import RecurrentAutoencoder

        return RecurrentAutoencoder(shape)

    def check(self) -> None:
        """Raise `UsageError` for options of joint learning without joint learning, and as `NetworkParams.check`."""
        super().check()
        if not self.joint:
            options = [(name, getattr(self, name)) for name in ("frozen_sensor", "pairing", "alignment_loss")]
            odd = [(name, value) for name, value in options if value and value not in ("random", "fixed", "pairs")]
            if odd:
                name, value = odd[0]
                option = name.replace("_", "-")
                raise UsageError(
                    f"{name} is {value} and sensors are not learned jointly; leave out --no-joint or --{option}."
                )


@dataclass(frozen=True)
class XLSTM(NetworkParams):
    """The recurrent classifier without decoder that the paper compares with, trained separately per sensor."""

    # x-lstm: the paper's classifier without decoder
    architecture: Literal["x-lstm"] = "x-lstm"
    TITLE: ClassVar[str] = "X-LSTM"
    dropout: Dropout = added(0.0)  # dropout of the last state in training; 0.2 in the paper's text
    PRESETS: ClassVar[Presets] = {"paper": _PAPER_TEXT, "quick": {"epochs": 30}}

    def shape(self, channels: int, header: str, classes: int) -> AutoencoderShape:
        """Return the sizes of a sensor's network."""
        return dataclasses.replace(super().shape(channels, header, classes), dropout=self.dropout)

    def build(self, shape: AutoencoderShape) -> nn.Module:
        """Return the paper's recurrent classifier."""
        from tacpipe.models.recurrent_autoencoder import RecurrentClassifier

        return RecurrentClassifier(shape)


Params = MaterialModelParams  # params of any architecture


class StoredNaming(TypedDict):
    """Naming of classes in a model's configuration; empty for whole numbers under the default key."""

    label: NotRequired[str]
    names: NotRequired[list[str]]


class StoredLayout(TypedDict):
    """The layout of a sensor's slides, in a model's configuration."""

    channels: list[str]
    frames: int
    rate_hz: float
    layout: str


class BestEpochs(TypedDict):
    """Epoch of each sensor's weights, and the validation accuracy at that epoch."""

    epoch: dict[str, int]
    accuracy: dict[str, float]


class SpectraDescription(TypedDict):
    """Frequency bands of spectra, and the speed of each sensor's slides."""

    way_m: float
    edges_per_m: list[float]
    speed_m_s: dict[str, float]


class UnknownDescription(TypedDict):
    """Calibration of a sensor's probabilities and of its threshold of unknown."""

    slides: int
    temperature: float
    rule: str
    threshold: float
    false_unknown: float
    auroc_left_out: dict[Literal["probability", "distance"], float]
    calibration_error: dict[str, float]  # calibration error before and after calibration


class MaterialConfig(ModelConfig, StoredNaming):
    """``config.json`` of a material model."""

    split: str  # description
    quantities: Sequence[str]
    sensors: dict[str, StoredLayout]
    classes: list[int]
    absent: NotRequired[list[str]]  # quantities that no sensor has
    counts: dict[str, dict[str, int]]  # role -> sensor -> number of slides
    shapes: NotRequired[dict[str, dict[str, Any]]]  # networks only: the fields of `AutoencoderShape`
    scaling: NotRequired[dict[str, dict[str, list[float]]]]
    joint: NotRequired[bool]
    held_out: NotRequired[dict[str, list[int]]]  # sensor -> classes whose labels it does not learn
    partners: NotRequired[dict[str, int]]  # class -> its partner across sensors
    validation: NotRequired[BestEpochs]
    spectra: NotRequired[SpectraDescription]
    known: NotRequired[dict[str, UnknownDescription]]  # by sensor, only in calibrated models


def aligning_architectures() -> list[str]:
    """Return the names of the architectures whose networks can be aligned to a frozen one."""
    able = [kind for kind in architectures.kinds(MaterialModelParams) if kind.ALIGNS_SENSORS]
    return [name for kind in able for name in fields.choices(kind, architectures.TAG)]
