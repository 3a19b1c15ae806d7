"""What a live session published, as the stream ``forecast`` of its recording holds it."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tacpipe.arrays import Float32s, Times
from tacpipe.tasks.forward.live.chain import Forecast


@dataclass(frozen=True)
class Published:
    """The forecasts of a session, and the quantiles that it published next to them."""

    t_ns: Times  # (row,), of the grid points
    steps: tuple[int, ...]
    values: Float32s  # (row, step, channel)
    levels: tuple[int, ...]  # of the quantiles, in percent; empty where it published none
    quantiles: Float32s  # (row, level x step, channel)

    @classmethod
    def of(cls, forecast: Any, channels: Sequence[str], known: Sequence[int] = ()) -> Published:
        """Return what a stream of forecasts (an arrow table) of some channels holds, and quantiles of ``known`` levels."""
        ends = {name.rpartition("_t")[2] for name in forecast.column_names if name.rpartition("_t")[0] in channels}
        steps = sorted({int(end.partition("_q")[0]) for end in ends})
        levels = [level for level in known if any(end.endswith(f"_q{level}") for end in ends)]

        def stacked(endings: Sequence[str]) -> Float32s:
            found = np.empty((forecast.num_rows, len(endings), len(channels)), np.float32)
            for place, ending in enumerate(endings):
                for channel, name in enumerate(channels):
                    found[:, place, channel] = forecast.column(f"{name}_{ending}").to_numpy()
            return found

        values = stacked([f"t{step}" for step in steps])
        quantiles = stacked([f"t{step}_q{level}" for level, step in itertools.product(levels, steps)])
        return cls(times(forecast), tuple(steps), values, tuple(levels), quantiles)

    def whole(self) -> Float32s:
        """Return values and quantiles (row, step + level x step, channel)."""
        return np.concatenate([self.values, self.quantiles], axis=1)

    def alike(self, forecasts: Sequence[Forecast]) -> Float32s:
        """Return the same of other forecasts, which all have values and as many quantiles as were published."""
        wanted = [step - 1 for step in self.steps]
        rows: list[Float32s] = []
        for one in forecasts:
            assert one.count is not None
            levels: list[Float32s] = []
            if one.quantiles is not None:
                levels = list(one.quantiles[wanted].transpose(2, 0, 1))
            rows.append(np.concatenate([one.count[wanted], *levels]))
        return np.stack(rows) if rows else self.whole()[:0]


def times(stream: Any) -> Times:
    """Return the times of the rows that a stream of a session is about (row,)."""
    found: Times = stream.column("t_device_ns").to_numpy()
    return found
