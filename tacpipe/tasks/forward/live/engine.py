"""Forecast at each grid point of a live session, as soon as its samples have arrived.

If several grid points are due, this process fell behind: the newest is published, and the others are counted as
skipped.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar

import numpy as np

from tacpipe.io import Json
from tacpipe.live.engine import SETTLE_NS
from tacpipe.live.rows import RowEngine
from tacpipe.sensors.sensor import Sensor
from tacpipe.tasks.forward.live.chain import Cause, GridForecast, LiveChain
from tacpipe.tasks.forward.live.messages import ForecastDescription, ForecastMessage


class ForecastEngine(RowEngine[LiveChain]):
    """Run the forecasts of a live session, with a new chain for each recording and after blocks were dropped."""

    most_rows: ClassVar[int] = 1

    def __init__(
        self,
        sensors: Mapping[str, Sensor],
        open_chain: Callable[[Json | None], LiveChain],
        steps: Sequence[int] | None = None,
        *,
        settle_ns: int = SETTLE_NS,
        quantiles: Sequence[int] = (),
    ) -> None:
        """Start without samples; ``open_chain`` returns a chain that continues a beginning, or begins if it is None.

        Without ``steps`` all steps are published.
        """
        super().__init__(sensors, open_chain, settle_ns=settle_ns)
        self.quantiles = tuple(quantiles)
        self.steps = tuple(steps) if steps else tuple(range(1, self.rows.horizon + 1))

    @property
    def period_ns(self) -> int:
        """The interval between grid points."""
        return round(1e9 / self.rows.rate_hz)

    @property
    def states(self) -> dict[str, str]:
        """The rows that gave the level at rest, and the numbers of late samples by stream."""
        return {**({} if self.rows.beginning is None else {"level at rest": self.rows.rest_rows}), **super().states}

    def describe(self, model: str) -> ForecastDescription:
        """Return the description of the values in messages."""
        chain = self.rows
        return ForecastDescription(chain.channels, self.steps, chain.unit, chain.rate_hz, model, self.quantiles)

    def advance(self, until_ns: int) -> list[GridForecast]:
        """Return the grid points up to a time, of which the newest alone is predicted."""
        return self.rows.advance(until_ns, newest_only=True)

    def message(self, row: GridForecast) -> ForecastMessage:
        """Return the message with a forecast, or with its cause if the forecast has no values."""
        values, levels = None, None
        if row.count is not None and row.now is not None:
            published_rows = [step - 1 for step in self.steps]
            values = np.ascontiguousarray(row.count[published_rows], dtype=np.float32)
            if row.quantiles is not None:
                levels = np.ascontiguousarray(row.quantiles[published_rows].transpose(2, 0, 1), dtype=np.float32)
        return ForecastMessage(
            self.next_seq(),
            row.t_ns,
            values,
            cause=describe_cause(row),
            flags=row.cause.value,
            made_from_t_ns=row.made_from_t_ns,
            levels=self.quantiles,
            quantiles=levels,
        )

    def no_answer(self, t_ns: int, cause: str) -> ForecastMessage:
        """Return a message without a forecast."""
        return ForecastMessage(self.next_seq(), t_ns, None, cause=cause, levels=self.quantiles)


def describe_cause(forecast: GridForecast) -> str:
    """Return the cause of a forecast in words.

    >>> describe_cause(GridForecast(0, 0, None, None, Cause.GAP | Cause.CONTEXT, ("xela2",)))
    'nothing new comes from xela2'
    """
    cause = forecast.cause
    if Cause.GAP in cause:
        return f"nothing new comes from {', '.join(forecast.gaps) or 'a stream'}"
    for flag, sentence in SENTENCES.items():
        if flag in cause:
            return sentence
    return ""


SENTENCES = {
    Cause.START: "the session begins: the level at rest is not known yet",
    Cause.VALUE: "a value is not finite",
    Cause.TIME: "it is not known when the newest row was measured",
    Cause.CONTEXT: "the model's context is being filled",
    Cause.PLAN_ENDED: "the plan has ended: the hand is taken to stay",
    Cause.NO_PLAN: "there is no plan: the hand is taken to move on",
}
