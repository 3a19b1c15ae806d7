"""Define headlines, which compare a model with its best baseline, with the uncertainty of the difference.

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
NONE = "–"


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
    measure: str  # kind of gain: "skill" (1 − error / error of the best baseline) or "points" (percentage points)
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

    @property
    def interval(self) -> str:
        """The description of the interval."""
        seeds = f" and {self.seeds} seeds" if self.seeds > 1 else ""
        methods = f", the best of {self.methods} methods" if self.methods > 1 else ""
        return f"95 % interval over {format_count(self.clusters, self.cluster)}{seeds}{methods}"

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


def explain_no_verdict(clusters: int, cluster: str, effective: float) -> str:
    """Return why there is no verdict, as a clause."""
    if clusters >= MIN_CLUSTERS and round(effective, 6) < MIN_CLUSTERS:
        return f"{format_count(clusters, cluster)} count as {effective:.1f} equal ones, too few for a verdict"
    return f"{format_count(clusters, cluster)} {'is' if clusters == 1 else 'are'} too few for a verdict"


def verdict(headlines: Sequence[Headline]) -> str:
    """Return the common verdict of several headlines: ``better`` or ``worse`` if all agree, otherwise ``unclear``."""
    verdicts = {headline.verdict for headline in headlines}
    return next(iter(verdicts)) if len(verdicts) == 1 else UNCLEAR if verdicts else NO_VERDICT


def sentence(headline: Headline) -> str:
    """Return the comparison with the best baseline as a sentence, as certain as the interval allows."""
    return f"{_capitalize(headline.where)}: {headline.method} {clause(headline)}."


def clause(headline: Headline) -> str:
    """Return the predicate of the method in a sentence: "is better than ridge, the best of 3 baselines: skill …"."""
    best = headline.best
    if best is None:
        return f"was evaluated without a baseline, on {format_count(headline.clusters, headline.cluster)}"
    name = f"{best.name}, the best of {len(headline.baselines)} baselines" if len(headline.baselines) > 1 else best.name
    gain = f"{amount(headline)}"
    if headline.verdict == NO_VERDICT:
        reason = explain_no_verdict(headline.clusters, headline.cluster, headline.effective)
        return f"has {gain} over the baseline {name}; {reason}"
    interval = f" ({bounds(headline)}, {headline.interval})"
    return {
        BETTER: f"is better than the baseline {name}: {gain}{interval}",
        WORSE: f"is worse than the baseline {name}: {gain}{interval}",
        UNCLEAR: f"does not differ measurably from the baseline {name}: {gain}{interval}",
    }[headline.verdict]


def amount(headline: Headline) -> str:
    """Return the gain with its name: "skill +0.119", "+3.5 points"."""
    gain = format_gain(headline.gain, headline.measure)
    return f"{gain} points" if headline.measure == "points" else f"{headline.measure} {gain}"


def bounds(headline: Headline) -> str:
    """Return the interval of the gain as text; empty if undefined."""
    if math.isnan(headline.low):
        return ""
    return f"{format_gain(headline.low, headline.measure)} to {format_gain(headline.high, headline.measure)}"


def format_gain(value: float, measure: str = "skill") -> str:
    """Return a gain with its sign, "not defined" for NaN; ``measure`` is skill or points."""
    if math.isnan(value):
        return "not defined"
    skill_digits = 3 if abs(value) < 10 else 0
    digits = 1 if measure == "points" else skill_digits
    return f"{round(value, digits) + 0.0:+.{digits}f}".replace("-", "−")


def number(value: float) -> str:
    """Format an error with four digits."""
    if math.isnan(value):
        return NONE
    return (f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}").replace("-", "−")


def format_count(count: int, plural: str) -> str:
    """Format a count with its noun."""
    return f"{count:,} {plural.removesuffix('s') if count == 1 else plural}"


def table(headlines: Sequence[Headline]) -> tuple[list[str], list[list[str]]]:
    """Return the header and the rows of a table of headlines, which must have the same columns.

    Each headline has a row for the model, one for its best baseline, and one for each other baseline of the table.
    """
    if not headlines:
        return [], []
    first = headlines[0]
    heads = ["", "", *first.columns, first.measure, "95 % interval", "n"]
    rows = []
    for headline in headlines:
        best = headline.best
        gain_cells = [format_gain(headline.gain, headline.measure) if best else NONE, bounds(headline) or NONE]
        n = format_count(headline.clusters, headline.cluster) + (
            f", {headline.seeds} seeds" if headline.seeds > 1 else ""
        )
        rows.append([headline.where, headline.method, *map(number, headline.model.values), *gain_cells, n])
        if best:
            verdicts = {BETTER: "model is better", WORSE: "baseline is better", UNCLEAR: "no clear difference"}
            verdict_text = verdicts.get(headline.verdict, "too few for a verdict")
            rows.append(["", f"best baseline: {best.name}", *map(number, best.values), "", verdict_text, ""])
            rows += [
                ["", row.name, *map(number, row.values), "", "", ""]
                for row in headline.table_baselines
                if row is not best
            ]
    return heads, rows


def caption(headlines: Sequence[Headline]) -> str:
    """Return a caption that explains the columns of `table`."""
    first = headlines[0]
    skill = f" Skill is 1 − error / error of the best baseline; the error is {first.ranked_by}."
    points = f" Points are percentage points of {first.ranked_by} above the best baseline."
    over = {f"{headline.cluster}{' and seeds' if headline.seeds > 1 else ''}" for headline in headlines}
    return (
        f"Units: {first.unit}.{points if first.measure == 'points' else skill} Intervals: jackknife over "
        f"{' or '.join(sorted(over))}, model and baseline on the same ones.{_omission_note(headlines)}"
    )


def _omission_note(headlines: Sequence[Headline]) -> str:
    count = sum(headline.left_out for headline in headlines)
    return (
        f" Left out: {format_count(count, 'recordings')} without an error of {headlines[0].reference}." if count else ""
    )


def _capitalize(words: str) -> str:
    return words[:1].upper() + words[1:]


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
    weakest = min(headlines, key=lambda headline: math.inf if math.isnan(headline.gain) else headline.gain)
    summary: dict[str, float | int] = {
        "gain": weakest.gain,
        "low": weakest.low,
        "high": weakest.high,
        "n": weakest.clusters,
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
