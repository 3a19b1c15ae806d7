"""Define the interface of trackers of experiments, and flatten params, epochs and figures for them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

Scalar = str | int | float | bool
_LABELS = ("target", "network")  # labels in the lines of several networks


class Tracker(Protocol):
    """A run of one tracker. It is made with the place behind the colon of ``--track NAME:PLACE``, empty for its own.

    Whatever a method raises is reported once, and the tracker is not called again: it ends no training.
    """

    def start(self, name: str, params: Mapping[str, Scalar]) -> str:
        """Begin the run ``name``, which is unique to a result, or resume it; return where it can be seen.

        A run that is resumed is given all its epochs again.
        """

    def line(self, epoch: int, metrics: Mapping[str, float]) -> None:
        """Add the metrics of an epoch, from 1: losses, learning rate, and what else is validated."""

    def end(self, path: Path | None, figures: Mapping[str, float]) -> None:
        """End the run: its model or results are at ``path``, with these figures; None where they were not made."""


def params(nested: Mapping[str, Any]) -> dict[str, Scalar]:
    """Return params by dotted name; lists as text.

    >>> params({"epochs": 2, "sweep": {"kind": "pca", "widths": [2, 4]}, "init": None})
    {'epochs': 2, 'sweep.kind': 'pca', 'sweep.widths': '2, 4', 'init': 'none'}
    """
    return dict(_leaves(nested, "."))


def figures(nested: Mapping[str, Any], under: str = "") -> dict[str, float]:
    """Return the numbers in nested values by their path; what is not a finite number is left out.

    >>> figures({"val_loss": 0.5, "best": True, "val": {"biotac": {"accuracy": 0.25}}, "note": "x"}, "a/")
    {'a/val_loss': 0.5, 'a/val/biotac/accuracy': 0.25}
    """
    return {f"{under}{name}": float(value) for name, value in _leaves(nested, "/") if _is_number(value)}


def metrics(line: Mapping[str, Any], *, labelled: bool) -> dict[str, float]:
    """Return the metrics of a line of a history, below its labels if ``labelled``: where there are several networks.

    >>> metrics({"epoch": 3, "val_loss": 0.5, "target": "pdc_th", "network": 1}, labelled=True)
    {'pdc_th/1/val_loss': 0.5}
    """
    under = "".join(f"{line[name]}/" for name in _LABELS if name in line) if labelled else ""
    return figures({name: value for name, value in line.items() if name not in ("epoch", *_LABELS)}, under)


def has_several_networks(lines: Iterable[Mapping[str, Any]]) -> bool:
    """Return whether the lines of a history are of several networks."""
    return len({tuple(line.get(name) for name in _LABELS) for line in lines}) > 1


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _leaves(value: Mapping[str, Any], between: str, name: str = "") -> Iterable[tuple[str, Scalar]]:
    for key, entry in value.items():
        path = f"{name}{between}{key}" if name else str(key)
        if isinstance(entry, Mapping):
            yield from _leaves(entry, between, path)
        elif isinstance(entry, Sequence) and not isinstance(entry, str):
            yield path, ", ".join(map(str, entry))
        else:
            yield path, "none" if entry is None else entry
