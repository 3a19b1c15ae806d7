"""A result of a task that the page knows nothing about: its numbers as they are named."""

from __future__ import annotations

import json
from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING, Any

from tacpipe.report import contents, markup, provenance

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset


def render(result: Dataset, number: int, of: int) -> str:
    """Return the part of the page that one result has: the ``number``-th ``of`` so many."""
    config = contents.tree(result, "config.json")
    name = ": ".join(str(config[key]) for key in ("task", "architecture") if key in config) or "result"
    badge = ' <span class="badge">simulated</span>' if provenance.simulated(result) else ""
    rows = [[name, value] for name, value in leaves(contents.tree(result, "metrics.json")).items()]
    return (
        f"<h2>{f'{number}. ' if of > 1 else ''}{escape(name.replace('_', ' '))}{badge}</h2>\n"
        f"{markup.table('Metrics', ['', 'value'], rows)}\n{provenance.section(result.manifest)}\n"
    )


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
            found[name] = markup.number(value)
        else:
            found[name] = markup.NONE if value is None else json.dumps(value)
    return found
