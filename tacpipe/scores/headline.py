"""Define headlines, which compare a model with its best baseline, and their JSON, verdicts and summary.

Tasks compute headlines (`tacpipe.headlines`), ``tacpipe evaluate`` writes them to ``headline.json`` and prints them,
and reports and ``tacpipe show`` display them. This module imports neither numpy nor any other package that slows a
cache hit.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import Any, TypedDict

from tacpipe.io import Json

FILE = "headline.json"
# minimum for a verdict: 5 clusters all favour the same side with probability 1/16, which is more than 5 %
MIN_CLUSTERS = 6
BETTER, WORSE, UNCLEAR, NO_VERDICT = "better", "worse", "unclear", ""


@dataclass(frozen=True)
class HeadlineRow:
    """The errors of one predictor, one value per column of the headline; NaN if undefined."""

    name: str
    values: tuple[float, ...]


@dataclass(frozen=True)
class Headline:
    """A model and its baselines on one part of the recordings, all evaluated on the same recordings."""

    task: str
    method: str
    part: str  # recordings: "unseen objects", "BioTac"; empty: all recordings that the model was not trained on
    target: str  # predicted target, if there are several in a part; empty: all
    columns: tuple[str, ...]  # names of the errors
    unit: str  # unit of the errors, in words
    ranked_by: str  # the error that ranks the baselines and determines the gain
    model: HeadlineRow
    baselines: tuple[HeadlineRow, ...]  # best first
    # kind of gain: "skill" (1 − error / error of the best baseline), "points" (percentage points) or "area" (difference of
    # areas under the curve)
    measure: str
    gain: float  # gain of the model over the best baseline; NaN if undefined
    low: float  # 95 % interval of the gain; NaN with fewer than three clusters
    high: float
    clusters: int  # number of units of the interval
    cluster: str  # plural name of the units: "recordings", "slides", "grasps", "objects"
    runs: int
    seeds: int  # if several, they are also units of the interval
    effective: float = float("nan")  # effective number of clusters; NaN in older results
    methods: int = 1  # number of methods from which the model was selected as the best
    reference: str = ""  # the baseline that tables show next to the best one
    left_out: int = 0  # number of recordings without an error of the reference, so without a ratio to it

    @property
    def best(self) -> HeadlineRow | None:
        """The best baseline, or None if none was evaluated."""
        return self.baselines[0] if self.baselines else None

    @property
    def table_baselines(self) -> tuple[HeadlineRow, ...]:
        """The baselines that tables show: the best one and the reference."""
        return tuple(row for row in self.baselines if row is self.best or row.name == self.reference)

    @property
    def verdict(self) -> str:
        """The comparison with the best baseline (`verdict_of`); empty if there is no baseline."""
        return verdict_of(self.low, self.high, self.clusters, self.effective)

    @property
    def where(self) -> str:
        """Part and target in words."""
        return ", ".join(filter(None, (self.target, self.part))) or "all recordings"

    def to_json(self) -> Json:
        """Return the headline as JSON, with its best baseline and verdict; undefined values are null."""
        fields = asdict(self)
        best = self.best
        return {**_to_json(fields), "best_baseline": best.name if best else None, "verdict": self.verdict}

    @classmethod
    def from_json(cls, value: Json) -> Headline:
        """Return the headline that `to_json` stored."""
        fields = {name: value[name] for name in cls.__dataclass_fields__ if name in value}
        fields |= {name: _number(fields.get(name)) for name in ("gain", "low", "high", "effective")}
        fields |= {"columns": tuple(value["columns"]), "model": _row(value["model"])}
        return cls(**{**fields, "baselines": tuple(map(_row, value["baselines"]))})


def write(headlines: Sequence[Headline]) -> bytes:
    """Return the content of ``headline.json``."""
    content = {"headlines": [headline.to_json() for headline in headlines]}
    return (json.dumps(content, indent=1, sort_keys=True, allow_nan=False) + "\n").encode()


def read(content: bytes) -> list[Headline]:
    """Parse the headlines in ``headline.json``."""
    return [Headline.from_json(stored) for stored in json.loads(content)["headlines"]]


def verdict_of(low: float, high: float, clusters: int, effective: float) -> str:
    """Return ``better`` or ``worse`` if the interval of a gain excludes 0, otherwise ``unclear``.

    Returns the empty string if there is no interval, or its coverage may be below 95 %: fewer than `MIN_CLUSTERS`
    clusters, or a smaller ``effective`` number.
    """
    if clusters < MIN_CLUSTERS or round(effective, 6) < MIN_CLUSTERS or math.isnan(low) or math.isnan(high):
        return NO_VERDICT
    if low > 0:
        return BETTER
    return WORSE if high < 0 else UNCLEAR


def _to_json(value: Any) -> Any:
    """Return values for JSON: undefined numbers as null, floats with 9 digits; more would differ between machines."""
    if isinstance(value, dict):
        return {name: _to_json(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_to_json(entry) for entry in value]
    if isinstance(value, float):
        return float(f"{value:.9g}") if math.isfinite(value) else None
    return value


class StoredRow(TypedDict):
    """A `HeadlineRow` in ``headline.json``; undefined values are null."""

    name: str
    values: list[float | None]


def _row(value: StoredRow) -> HeadlineRow:
    return HeadlineRow(value["name"], tuple(_number(number) for number in value["values"]))


def _number(value: float | None) -> float:
    return float("nan") if value is None else float(value)


def weakest(headlines: Sequence[Headline]) -> Headline:
    """Return the headline with the smallest gain; one without a defined gain only if there is no other."""
    return min(headlines, key=lambda headline: math.inf if math.isnan(headline.gain) else headline.gain)


SUMMARY = "summary.json"
MAX_NUMBERS = 30  # maximum number of entries; further ones are dropped
Names = Mapping[str, str]


def summarize(headlines: Sequence[Headline], names: Names = MappingProxyType({})) -> dict[str, float | int]:
    """Return the smallest gain over the best baseline, with its interval and clusters, and one error per part and target.

    ``gain``, ``low``, ``high`` and ``n`` belong to the headline with the smallest gain, because a model is better than
    its baselines only if all its headlines are. Errors are those of the last column, named by the target if there are
    several. ``names`` maps parts and targets to short names. Undefined values are omitted. If tables show a reference,
    the mean absolute errors of model and reference follow.
    """
    if not headlines:
        return {}
    smallest = weakest(headlines)
    summary: dict[str, float | int] = {
        "gain": smallest.gain,
        "low": smallest.low,
        "high": smallest.high,
        "n": smallest.clusters,
    }
    # all targets have the same measure, so its name is omitted
    has_targets = len({headline.target for headline in headlines}) > 1
    for headline, prefix in zip(headlines, _distinct_names(headlines, names), strict=True):
        name = "_".join(prefix if has_targets else [*prefix, _to_identifier(headline.columns[-1])])
        summary[name] = headline.model.values[-1]
    for headline, prefix in zip(headlines, _distinct_names(headlines, names), strict=True):
        reference = next((row for row in headline.baselines if row.name == headline.reference), None)
        for index, column in enumerate(headline.columns if reference else ()):
            if reference and column.startswith("MAE"):
                summary["_".join([*prefix, _to_identifier(column)])] = headline.model.values[index]
                summary["_".join([*prefix, reference.name, _to_identifier(column)])] = reference.values[index]
    finite = {name: value for name, value in summary.items() if math.isfinite(value)}
    return {name: _round_float(value) for name, value in list(finite.items())[: MAX_NUMBERS - 1]}


def write_summary(headlines: Sequence[Headline], names: Names = MappingProxyType({})) -> bytes:
    """Return the content of ``summary.json``."""
    return (json.dumps(summarize(headlines, names), indent=1, allow_nan=False) + "\n").encode()


def _distinct_names(headlines: Sequence[Headline], names: Names) -> list[list[str]]:
    """Return the short names of target and part of each headline, omitting those that all headlines share."""
    names_by_headline: list[list[str]] = [[] for _ in headlines]
    for texts in ([headline.target for headline in headlines], [headline.part for headline in headlines]):
        if len(set(texts)) > 1:
            for parts, text in zip(names_by_headline, texts, strict=True):
                parts.append(names.get(text) or _to_identifier(text))
    return names_by_headline


def _to_identifier(text: str) -> str:
    """Return text as an identifier.

    >>> [_to_identifier(text) for text in ("vs persistence", "accuracy (%)", "RMSE (counts)", "unseen objects")]
    ['vs_persistence', 'accuracy', 'rmse', 'unseen_objects']
    """
    return "_".join(re.findall(r"[a-z0-9]+", re.sub(r"\(.*?\)", "", text.lower())))


def _round_float(value: float | int) -> float | int:
    return float(f"{value:.6g}") if isinstance(value, float) else value
