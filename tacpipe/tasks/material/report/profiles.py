"""How slides went: force and speed over time, Figures 5 and 6 of the paper, and how many kept to the protocol."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.report import charts, provenance
from tacpipe.report.blocks import Chart, Charts, Fold, Note, counted, form, listed
from tacpipe.report.charts import Line
from tacpipe.tasks.material.report.methods import Result, ordered, shown

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Recording

SLIDE, PROFILE = "slide", "profile"


def reads(dataset: Dataset) -> bool:
    """Return whether a dataset holds slides."""
    return any(SLIDE in shard.streams or PROFILE in shard.streams for shard in dataset.recordings.values())


def folds(datasets: Sequence[Dataset]) -> list[Fold]:
    """Return what slides were like; nothing without any."""
    shards = [shard for one in datasets for shard in one.recordings.values() if reads(one)]
    if not shards:
        return []
    published = all(provenance.published(one, Result.SETS) for one in datasets)
    sensors = ordered([str(shard.attributes.get("sensor", "")) for shard in shards])
    parts = [_counts([shard for shard in shards if shard.attributes.get("sensor", "") == one], one) for one in sensors]
    drawn: list[Chart] = []
    for sensor in sensors:
        held = [one for one in shards if one.attributes.get("sensor", "") == sensor and PROFILE in one.streams]
        if held:
            drawn += _charts(typical(held), sensor, published)
    return [Fold("The slides", [Note(" ".join(parts)), *([Charts(drawn)] if drawn else [])])]


def typical(shards: Sequence[Recording]) -> Recording:
    """Return the slide of median force among those that kept to the protocol, or among all where none did."""
    kept = [one for one in shards if not one.attributes.get("outside_protocol")] or list(shards)

    def force(shard: Recording) -> tuple[float, str]:
        return float(shard.attributes.get("force_n") or 0.0), shard.name

    return sorted(kept, key=force)[len(kept) // 2]


def _counts(shards: Sequence[Recording], sensor: str) -> str:
    """Return how many slides there are of a sensor, and how many kept to the protocol."""
    outside = [one for one in shards if one.attributes.get("outside_protocol")]
    some = counted(len(shards), "slides")
    if not any("outside_protocol" in one.attributes for one in shards):
        return f"{some} of {shown(sensor)}."
    text = f"{some} of {shown(sensor)}, {len(outside):,} of them outside the protocol"
    reasons = Counter(str(one.attributes.get("outside_protocol_why", "")) for one in outside)
    described = [f"{count} {reason}" for reason, count in reasons.most_common() if reason]
    return text + (f" ({listed(described)})." if described else ".")


def _charts(shard: Recording, sensor: str, published: bool) -> list[Chart]:
    """Return force and speed of one slide."""
    table = shard.table(PROFILE)
    time_ns = table["t_ns"].to_numpy()
    time_s = (time_ns - time_ns[0]) / 1e9
    during = time_s[table["phase"].to_numpy() == 0]
    shade = (float(during[0]), float(during[-1])) if len(during) else None
    wanted = (
        ("Figure 5", f"force on {shown(sensor)}", "force (N)", {"force_n": "force"}, 1.0),
        (
            "Figure 6",
            f"speed on {shown(sensor)}",
            "speed (mm/s)",
            {"speed_raw_m_s": "as measured", "speed_m_s": "median of 3"},
            1000.0,
        ),
    )
    drawn = []
    for number, what, quantity, columns, scale in wanted:
        lines = {label: scale * table[name].to_numpy() for name, label in columns.items() if name in table.column_names}
        several = [Line(label, time_s, values) for label, values in lines.items() if np.isfinite(values).any()]
        if several:
            spec = charts.lines(several, "time (s)", quantity, shade=shade, points=False, height=190)
            caption = f"{shard.name}, the slide of median force. Shaded: the slide."
            drawn.append(Chart(form(number, what, published), spec, caption))
    return drawn
