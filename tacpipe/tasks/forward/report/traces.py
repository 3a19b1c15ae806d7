"""What was predicted of a recording's latents, drawn at the time at which it was known and not at the time it is for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.report import charts
from tacpipe.report.blocks import Chart
from tacpipe.report.charts import Line

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Recording

SHOWN_S = 12.0  # seconds of a recording that are drawn
TRUTH = "truth now"
UNSHIFTED = (
    "Each prediction stands at the time at which it was known: one that sees ahead runs left of the truth, "
    "persistence lies on it. Long recordings are drawn from their first seconds, thinned to what can be seen."
)


def draw(
    shard: Recording, latents: Sequence[int], steps: Sequence[int], title: str, caption: str = "", *, unit: str = ""
) -> list[Chart]:
    """Return the first seconds of some latents of a recording, by their place from 0, and what was predicted of them.

    ``unit`` is that of latents which are the channels themselves. Latents and steps that the recording does not hold are
    left out.
    """
    table = shard.table()
    if not table.num_rows:
        return []
    time_s = (table.column("t_ns").to_numpy() - table.column("t_ns")[0].as_py()) / 1e9
    time_s = time_s[time_s <= SHOWN_S]
    broken = np.concatenate([[False], np.diff(table.column("contact").to_numpy()) != 0])
    held = [name for name in table.column_names if f"{name}_t1" in table.column_names]

    def values(name: str) -> AnyFloats:
        column: AnyFloats = table.column(name).to_numpy().astype(np.float64)
        column[broken] = np.nan
        return column[: len(time_s)]

    drawn = []
    for latent in (held[index] for index in latents if index < len(held)):
        ahead = [step for step in steps if f"{latent}_t{step}" in table.column_names]
        several = [Line(TRUTH, time_s, values(latent))]
        several += [Line(f"t+{step}", time_s, values(f"{latent}_t{step}"), dashed=True) for step in ahead]
        quantity = f"{latent} ({unit})" if unit else latent
        spec = charts.lines(several, "time at which the prediction is known (s)", quantity, points=False, height=170)
        drawn.append(Chart(f"{title}: {latent}", spec, caption, wide=True))
    return drawn
