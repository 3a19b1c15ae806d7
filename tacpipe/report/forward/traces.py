"""What was predicted of a recording's latents, drawn at the time at which it was known and not at the time it is for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.report.forward import figures

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Recording

SHOWN_S = 12.0  # seconds of a recording that are drawn
UNSHIFTED = (
    "Each prediction stands at the time at which it was known: one that sees ahead runs left of the truth, "
    "persistence lies on it."
)


def draw(shard: Recording, latents: Sequence[int], steps: Sequence[int]) -> str:
    """Return the first seconds of some latents of a recording, by their place from 0, and what was predicted of them.

    Latents and steps that the recording does not hold are left out; empty where none is left.
    """
    table = shard.table()
    if not table.num_rows:
        return ""
    time_s = (table.column("t_ns").to_numpy() - table.column("t_ns")[0].as_py()) / 1e9
    shown_s = time_s[time_s <= SHOWN_S]
    broken = np.concatenate([[False], np.diff(table.column("contact").to_numpy()) != 0])
    held = [name for name in table.column_names if f"{name}_t1" in table.column_names]
    chosen = [held[index] for index in latents if index < len(held)]
    if not chosen:
        return ""

    def values(name: str) -> AnyFloats:
        column: AnyFloats = table.column(name).to_numpy().astype(np.float64)
        column[broken] = np.nan
        return column[: len(shown_s)]

    described = [step for step in steps if f"{chosen[0]}_t{step}" in table.column_names]
    ahead = {name: {f"t+{step}": values(f"{name}_t{step}") for step in described} for name in chosen}
    return figures.traces(shown_s, {name: values(name) for name in chosen}, ahead)
