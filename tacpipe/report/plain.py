"""A result that holds nothing to compare, or of a task without a specification: its headline and its numbers by name."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from tacpipe.metrics import headline
from tacpipe.report import contents, provenance
from tacpipe.report.blocks import NONE, Fold, number, table

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset


def sentence(results: Sequence[Dataset]) -> str:
    """Return the first headline of results as a sentence; what they lack where there is none."""
    for one in results:
        found = headline.read(one.files[headline.FILE]) if headline.FILE in one.files else []
        if found:
            return headline.sentence(found[0])
    counts = [contents.tree(one, "metrics.json").get("counts") for one in results]
    if all(one is not None and not one.get("recordings", one.get("n", True)) for one in counts):
        return headline.text([])
    return "These results hold no errors by recording, so methods cannot be compared: their numbers are below."


def folds(result: Dataset, place: int, of: int) -> list[Fold]:
    """Return the part of the page that one result has: the ``place``-th ``of`` so many."""
    config = contents.tree(result, "config.json")
    name = ": ".join(str(config[key]) for key in ("task", "architecture") if key in config) or "result"
    rows = [[name, value] for name, value in leaves(contents.tree(result, "metrics.json")).items()]
    held = headline.read(result.files[headline.FILE]) if headline.FILE in result.files else []
    first = [table("Next to its best baseline", *headline.table(held))] if held else []
    title = f"{f'{place}. ' if of > 1 else ''}{name.replace('_', ' ')}"
    return [Fold(title, [*first, table("Metrics", ["", "value"], rows), *provenance.parts(result.manifest)])]


def leaves(tree: Mapping[str, Any]) -> dict[str, str]:
    """Return the values of nested names as text, by the names that lead to each.

    >>> leaves({"model": {"accuracy": {"biotac": 0.5}}, "classes": [1, 2], "p": None})
    {'model, accuracy, biotac': '0.5', 'classes': '[1, 2]', 'p': '–'}
    """
    found: dict[str, str] = {}
    for name, value in tree.items():
        if isinstance(value, Mapping):
            found.update({f"{name}, {rest}": text for rest, text in leaves(value).items()})
        elif isinstance(value, int | float) and not isinstance(value, bool):
            found[name] = number(value).text
        else:
            found[name] = NONE if value is None else json.dumps(value)
    return found
