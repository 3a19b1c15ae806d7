"""What a model named a whole recording, as its material, next to its label, with the score of every name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tacpipe.traces.curves import described

if TYPE_CHECKING:
    import pyarrow as pa

MODEL, SCORE = "model", "score_"
LEADING = 5  # names of a chart


@dataclass(frozen=True)
class Named:
    """The names of one recording; all as text."""

    key: str  # of the label, such as ``material``
    label: str  # what the recording is labelled; empty where nobody did
    predicted: Mapping[str, str]  # by predictor, the model first; those that named nothing left out
    scores: Mapping[str, float]  # of the model, by name, in the order of columns

    @property
    def of_model(self) -> str:
        """What the model named it."""
        return self.predicted[MODEL]

    def leading(self) -> dict[str, float]:
        """Return the names of the largest scores, the largest first, and that of the label behind them.

        >>> Named("material", "7", {"model": "1"}, {str(one): -one for one in range(9)}).leading()
        {'0': 0, '1': -1, '2': -2, '3': -3, '7': -7}
        """
        order = sorted(self.scores, key=lambda name: -self.scores[name])
        first = order[:LEADING]
        if self.label in self.scores and self.label not in first:
            first[-1] = self.label
        return {name: self.scores[name] for name in first}

    @property
    def sentence(self) -> str:
        """What the model named it, and whether that is right.

        >>> Named("material", "cork", {"model": "felt"}, {}).sentence
        'material: felt predicted, but labelled cork'
        """
        found = self.of_model
        if not self.label:
            return f"{self.key}: {found} predicted"
        return (
            f"{self.key}: {found} predicted, {'as labelled' if found == self.label else f'but labelled {self.label}'}"
        )


def of_row(row: pa.Table, attributes: Mapping[str, Any]) -> Named | None:
    """Return the names in a recording's row of `tacpipe predict`, or of `tacpipe evaluate`; None where it has none.

    The quantity of a column (``label``, ``prediction``, ``score``) states what it holds. A row of `predict` names the
    recording in a column of the label's own name; the label is then the recording's.
    """
    values = row.to_pylist()[0]
    by_quantity: dict[str, list[str]] = {}
    for field in row.schema:
        by_quantity.setdefault(described(field).get("quantity", ""), []).append(str(field.name))
    columns = [name for name in by_quantity.get("prediction", []) if values[name] is not None]
    scores = {_class(name): float(values[name]) for name in by_quantity.get("score", []) if values[name] is not None}
    if not columns or not scores:
        return None
    labels = by_quantity.get("label", [])
    key = labels[0] if labels else columns[0]
    label = values[labels[0]] if labels else attributes.get(key)
    named = {name.replace("_", " "): str(values[name]) for name in columns} if labels else {MODEL: str(values[key])}
    if MODEL not in named:
        return None
    first = {MODEL: named.pop(MODEL)}
    return Named(key, "" if label is None else str(label), {**first, **named}, scores)


def _class(column: str) -> str:
    """Return the name that a column of scores is of: numbers were filled with zeros.

    >>> _class("score_03"), _class("score_00"), _class("score_cork")
    ('3', '0', 'cork')
    """
    name = column.removeprefix(SCORE)
    return str(int(name)) if name.isascii() and name.isdigit() else name
