"""The headlines of a result as a few numbers with short names, which DVC shows in a table and trackers beside a run."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from types import MappingProxyType

from tacpipe.metrics.headline import Headline

FILE = "summary.json"
MOST = 30  # numbers: those of headlines that would be more are left out
Names = Mapping[str, str]


def from_headlines(headlines: Sequence[Headline], names: Names = MappingProxyType({})) -> dict[str, float | int]:
    """Return the least gain over the best baseline with its interval and clusters, and an error a part and target.

    ``gain``, ``low``, ``high`` and ``n`` are of the headline whose gain is least: a model is better than its baselines only
    where each of its headlines is. Errors are of the last column of each, and named by the target where there are several.
    ``names`` are short names of parts and targets. What is not defined is left out. Where tables show a reference, the mean
    absolute errors of model and reference follow.
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
    targets = (
        len({headline.target for headline in headlines}) > 1
    )  # their errors are of one measure, which no name repeats
    for headline, place in zip(headlines, _places(headlines, names), strict=True):
        summary["_".join(place if targets else [*place, _short(headline.columns[-1])])] = headline.model.values[-1]
    for headline, place in zip(headlines, _places(headlines, names), strict=True):
        reference = next((row for row in headline.baselines if row.name == headline.reference), None)
        for at, column in enumerate(headline.columns if reference else ()):
            if reference and column.startswith("MAE"):
                summary["_".join([*place, _short(column)])] = headline.model.values[at]
                summary["_".join([*place, reference.name, _short(column)])] = reference.values[at]
    finite = {name: value for name, value in summary.items() if math.isfinite(value)}
    return {name: _rounded(value) for name, value in list(finite.items())[: MOST - 1]}


def write(headlines: Sequence[Headline], names: Names = MappingProxyType({})) -> bytes:
    """Return the content of ``summary.json``."""
    return (json.dumps(from_headlines(headlines, names), indent=1, allow_nan=False) + "\n").encode()


def _places(headlines: Sequence[Headline], names: Names) -> list[list[str]]:
    """Return the short names of target and part of each headline, without what is the same for all."""
    places: list[list[str]] = [[] for _ in headlines]
    for texts in ([headline.target for headline in headlines], [headline.part for headline in headlines]):
        if len(set(texts)) > 1:
            for place, text in zip(places, texts, strict=True):
                place.append(names.get(text) or _short(text))
    return places


def _short(text: str) -> str:
    """Return text as a name.

    >>> [_short(one) for one in ("vs persistence", "accuracy (%)", "RMSE (counts)", "unseen objects")]
    ['vs_persistence', 'accuracy', 'rmse', 'unseen_objects']
    """
    return "_".join(re.findall(r"[a-z0-9]+", re.sub(r"\(.*?\)", "", text.lower())))


def _rounded(value: float | int) -> float | int:
    return float(f"{value:.6g}") if isinstance(value, float) else value
