"""Define the messages of a session with a forecasting model: a forecast at each grid point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from tacpipe.arrays import Float32s
from tacpipe.io import JsonObject
from tacpipe.live import messages
from tacpipe.live.messages import ABSENT, Sizes, head_values
from tacpipe.sensors.live import LSL, Declaration, LiveColumn, MessageSizes, Value, latency_values

FORECAST = "forecast"  # the recorded stream
MATRIX = {"type": "array", "items": {"type": "array", "items": {"type": "number"}}}  # (step, channel)
QUANTILES: frozenset[str] = frozenset({"quantiles"})


def _value_columns(sizes: MessageSizes) -> list[LiveColumn]:
    """Return the columns of predicted values: each channel at each step."""
    return [
        LiveColumn(f"{channel}_t{step}", sizes.unit, {"step": str(step)})
        for step in sizes.steps
        for channel in sizes.channels
    ]


def _quantile_columns(sizes: MessageSizes) -> list[LiveColumn]:
    """Return the columns of quantiles: each value column at each level."""
    return [
        LiveColumn(f"{name}_q{level}", unit, {**metadata, "quantile": f"{level / 100:g}"})
        for level in sizes.quantiles
        for name, unit, metadata in _value_columns(sizes)
    ]


DECLARATION = Declaration(
    FORECAST,
    (
        *head_values(),
        Value(
            "values",
            "forecast above the level at rest, by step and channel; null: none",
            "array",
            streams=(FORECAST, LSL),
            unit="of the channels",
            quantity="prediction",
            columns=_value_columns,
            schema=lambda sizes: MATRIX,
        ),
        Value(
            "quantiles",
            "quantiles of the forecast by level in percent, as `values`; only in sessions that publish some",
            "object",
            unit="of the channels",
            schema=lambda sizes: {"type": "object", "properties": {str(level): MATRIX for level in sizes.quantiles}},
            attribute="quantiles_by_level",
        ),
        Value(
            "quantile_columns",
            "the same, recorded",
            streams=(FORECAST, LSL),
            unit="of the channels",
            quantity="prediction",
            columns=_quantile_columns,
        ),
        Value("cause", "reason why there is no forecast, or the missing input", "string"),
        *latency_values("latency_ms", "age_ms", "skipped"),
    ),
    {FORECAST: 0},
)


@dataclass
class ForecastMessage(messages.Message):
    """A forecast, or why there is none."""

    values: Float32s | None  # (step, channel), in the channels' unit above rest; None: no forecast
    levels: tuple[int, ...] = ()  # levels of the published quantiles in percent
    quantiles: Float32s | None = (
        None  # (level, step, channel), if the session publishes quantiles and there is a forecast
    )
    declaration: ClassVar[Declaration] = DECLARATION

    @property
    def absent(self) -> frozenset[str]:
        """The fields that are absent: quantiles, if the session publishes none."""
        return ABSENT if self.levels else QUANTILES

    @property
    def answers(self) -> bool:
        """Whether there is a forecast."""
        return self.values is not None

    @property
    def states(self) -> Mapping[str, str]:
        """No text, because a forecast has many numbers."""
        return {}

    @property
    def quantiles_by_level(self) -> dict[str, list[list[float]]] | None:
        """The quantiles (step, channel) by level, or None without a forecast."""
        if self.quantiles is None:
            return None
        return {str(level): rows.tolist() for level, rows in zip(self.levels, self.quantiles, strict=True)}

    @property
    def quantile_columns(self) -> Float32s | None:
        """The quantiles (level x step x channel,), or None without a forecast."""
        if self.quantiles is None:
            return None if self.levels else np.empty(0, np.float32)
        return self.quantiles.ravel()


@dataclass(frozen=True)
class ForecastDescription(messages.Description):
    """Describe the values of forecasts."""

    channels: tuple[str, ...]
    steps: tuple[int, ...]
    unit: str
    rate_hz: float
    model: str
    quantiles: tuple[int, ...] = ()  # levels in percent
    declaration: ClassVar[Declaration] = DECLARATION
    answers: ClassVar[str] = "forecasts"

    @property
    def sizes(self) -> Sizes:
        """The numbers of channels, steps and quantiles."""
        return Sizes(self.channels, self.steps, self.quantiles, self.unit)

    @property
    def absent(self) -> frozenset[str]:
        """The fields that are absent: quantiles, if the session publishes none."""
        return ABSENT if self.quantiles else QUANTILES

    @property
    def details(self) -> JsonObject:
        """What it states beside the kind of the messages."""
        return {
            "channels": list(self.channels),
            "steps": list(self.steps),
            "unit": self.unit,
            "rate_hz": self.rate_hz,
            "model": self.model,
            **({"quantiles": list(self.quantiles)} if self.quantiles else {}),
        }
