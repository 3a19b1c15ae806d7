"""Compute the headline of materials, the accuracy on a sensor's slides, and number the classes of labels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NotRequired, TypedDict

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tacpipe.arrays import AnyArray, AnyFloats, Int64s
from tacpipe.errors import TacpipeError
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import listed, plain
from tacpipe.scores.calibration import ConfidenceBin
from tacpipe.scores.pairing import Measure
from tacpipe.scores.table import MODEL, ScoreTable
from tacpipe.tasks.material.params import KEY, StoredNaming

TASK = "material"
CHANCE = "chance"
# baselines; other predictors are controls or the model itself
BASELINES = {"mean_level": "mean level alone", "level_only": "same readout of the level alone"}


SENSORS = {"biotac": "BioTac", "roboskin": "RoboSkin"}


def sensor_title(sensor: str) -> str:
    """Return the display name of a sensor.

    >>> sensor_title("biotac"), sensor_title("xela1")
    ('BioTac', 'xela1')
    """
    return SENSORS.get(sensor, sensor)


def score_table(right: Mapping[str, Mapping[str, bool]], classes: int) -> ScoreTable:
    """Return the table of scores of a sensor's slides.

    ``right`` states by predictor and slide whether the material is right. Guessing among ``classes`` is another predictor,
    unless ``classes`` is 0.
    """
    sums = {
        name: {slide: np.array([float(is_right), 1.0]) for slide, is_right in slides.items()}
        for name, slides in right.items()
        if slides
    }
    if classes:
        sums[CHANCE] = {slide: np.array([1 / classes, 1.0]) for slide in right.get(MODEL, {})}
    return ScoreTable(MEASURE, sums, baselines={**BASELINES, CHANCE: CHANCE})


def _wrong(sums: AnyFloats) -> AnyFloats:
    return np.where(sums[:, 1] > 0, 1 - sums[:, 0] / np.maximum(sums[:, 1], 1), np.nan)


MEASURE = Measure(
    ("accuracy (%)",),
    "percent of slides",
    "accuracy",
    "points",
    "slides",
    _wrong,
    lambda wrong, baseline: 100 * (baseline - wrong),
    lambda sums: (100 * (1 - float(_wrong(sums[None])[0])),),
    lambda wrong: 100 * (1 - wrong),
    "accuracy (%)",
    rises=True,
    weight=lambda draws: draws[:, 1],
)


class SensorAccuracy(TypedDict):
    """Accuracy of a predictor by sensor, with the 95 % Wilson interval."""

    accuracy: dict[str, float]
    correct: dict[str, int]
    n: dict[str, int]
    low: dict[str, float]
    high: dict[str, float]


class HeldOutAccuracy(SensorAccuracy):
    """Accuracy on materials whose labels a sensor did not learn, and that of guessing."""

    chance: dict[str, float]


class ZeroShotAccuracy(HeldOutAccuracy):
    """Accuracy among all materials, and among the held-out ones only."""

    among_held_out: NotRequired[HeldOutAccuracy]


class StatedProbabilities(TypedDict):
    """How well predicted probabilities of learned classes fit the slides."""

    calibration_error: float
    log_loss: float
    confidence: float
    reliability: list[ConfidenceBin]


class ProbabilityMeasures(TypedDict):
    """Probabilities of a sensor's classes before and after calibration."""

    n: int
    temperature: float
    before: StatedProbabilities
    after: StatedProbabilities


class UnknownMeasures(TypedDict):
    """Answers of a calibrated classifier for one sensor's slides of learned and of other classes.

    Rates include their number of slides and the bounds of their 95 % interval.
    """

    rule: Literal["probability", "distance"]
    threshold: float
    false_unknown: NotRequired[float]
    false_unknown_n: NotRequired[int]
    false_unknown_low: NotRequired[float]
    false_unknown_high: NotRequired[float]
    false_known: NotRequired[float]
    false_known_n: NotRequired[int]
    false_known_materials: NotRequired[int]
    false_known_low: NotRequired[float]
    false_known_high: NotRequired[float]
    auroc: NotRequired[dict[Literal["probability", "distance"], float]]
    accuracy_of_answers: NotRequired[float]


class MaterialMetrics(TypedDict, total=False):
    """Entries of ``metrics.json`` besides accuracies; entries without slides are omitted."""

    calibration: dict[str, ProbabilityMeasures]  # sensor -> measures
    unknown: dict[str, UnknownMeasures]  # sensor -> measures
    zero_shot: ZeroShotAccuracy


UNKNOWN = -1  # number of a slide without a label


@dataclass(frozen=True)
class Naming:
    """Label key that contains the class, and the class names in order; without names, classes are whole numbers."""

    key: str = KEY
    names: tuple[str, ...] = ()

    @classmethod
    def from_labels(cls, key: str, labels: Iterable[Attribute]) -> Naming:
        """Return the naming of labels: integers from 0 are used unchanged, any others are sorted and numbered as text.

        >>> Naming.from_labels("material", [3, 1]).names, Naming.from_labels("object", ["cup", None, "can"]).names
        ((), ('can', 'cup'))
        """
        present = [label for label in labels if label is not None]
        if all(_is_number(label) for label in present):
            return cls(key)
        return cls(key, tuple(sorted({label_text(label) for label in present})))

    def number(self, label: Attribute) -> int:
        """Return the number of a label, or `UNKNOWN` for None. Raises `TacpipeError` for a label without a number."""
        if label is None:
            return UNKNOWN
        if not self.names:
            if isinstance(label, int) and _is_number(label):
                return label
            raise TacpipeError(f"{self.key} {plain(label_text(label))} is not a whole number from 0, as the others are")
        if label_text(label) not in self.names:
            raise TacpipeError(f"{self.key} {plain(label_text(label))} is not one of {listed(self.names, 20)}")
        return self.names.index(label_text(label))

    def read(self, word: str) -> int:
        """Return the number of a class from an option. Raises `ValueError` if there is no class of this name."""
        return self.names.index(word) if self.names else int(word)

    def name(self, number: int) -> str:
        """Return the name of a class for messages and columns.

        >>> Naming().name(3), Naming("material", ("cork", "felt")).name(1)
        ('3', 'felt')
        """
        return self.names[number] if self.names else str(number)

    def names_for(self, numbers: Int64s) -> NDArray[Any]:
        """Return the names of classes (slide,): text, or numbers if the classes have no names."""
        if not self.names:
            return numbers
        return np.array([self.names[number] if number >= 0 else "" for number in numbers.tolist()], dtype=np.str_)

    def add_to_config(self, config: StoredNaming) -> None:
        """Add the naming to a model's configuration; whole numbers under the default key add nothing."""
        if self.key != KEY:
            config["label"] = self.key
        if self.names:
            config["names"] = list(self.names)

    @classmethod
    def from_json(cls, config: StoredNaming) -> Naming:
        """Return the naming in a model's configuration."""
        return cls(str(config.get("label", KEY)), tuple(map(str, config.get("names", ()))))


NUMBERS = Naming()  # whole numbers, under the default key


def label_text(label: Attribute) -> str:
    """Return a label as text; booleans are written as in YAML.

    >>> label_text(True), label_text(3), label_text("cork")
    ('true', '3', 'cork')
    """
    return str(label).lower() if isinstance(label, bool) else str(label)


def label_field(name: str, values: AnyArray, quantity: str) -> tuple[pa.Field, list[Any]]:
    """Return a column of classes and its values: int32 for whole numbers, otherwise text; unknown classes are null."""
    metadata = {"quantity": quantity}
    if values.dtype.kind in "iu":
        return pa.field(name, pa.int32(), metadata=metadata), values.tolist()
    return pa.field(name, pa.string(), metadata=metadata), [name or None for name in values.tolist()]


def _is_number(label: Attribute) -> bool:
    return isinstance(label, int) and not isinstance(label, bool) and label >= 0
