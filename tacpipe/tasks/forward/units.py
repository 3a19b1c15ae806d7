"""The unit in which a forecaster's errors are given: that of the tactile channels it was trained on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pyarrow as pa

COUNT, COUNTS = "count", "counts"  # the unit in columns and in texts
MIXED = "own units"  # unit of channels, or of models, that differ


def of_channels(schema: pa.Schema, channels: Sequence[str]) -> str:
    """Return the unit of tactile columns, `MIXED` where they have several."""
    units = {(schema.field(name).metadata or {}).get(b"unit", b"").decode() or COUNT for name in channels}
    return units.pop() if len(units) == 1 else MIXED


def of_model(config: Mapping[str, Any]) -> str:
    """Return the unit in a model's configuration, as texts have it; one without is in counts.

    >>> of_model({"inputs": {}}), of_model({"inputs": {"unit": "kPa"}})
    ('counts', 'kPa')
    """
    return str(config.get("inputs", {}).get("unit", COUNTS))


def common(configs: Iterable[Mapping[str, Any]]) -> str:
    """Return the unit that models have in common, `MIXED` where they differ."""
    units = {of_model(config) for config in configs} or {COUNTS}
    return units.pop() if len(units) == 1 else MIXED
