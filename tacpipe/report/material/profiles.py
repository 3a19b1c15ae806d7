"""How slides went: force and speed over time, Figures 5 and 6 of the paper, and how many kept to the protocol."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.report import markup, provenance
from tacpipe.report.markup import listed
from tacpipe.report.material import figures, wording
from tacpipe.report.material.methods import PAPERS_SETS, ordered, shown

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Recording

SLIDE, PROFILE = "slide", "profile"


def reads(dataset: Dataset) -> bool:
    """Return whether a dataset holds slides."""
    return any(SLIDE in shard.streams or PROFILE in shard.streams for shard in dataset.recordings.values())


def section(datasets: Sequence[Dataset]) -> str:
    """Return what slides were like; empty without any."""
    shards = [shard for one in datasets for shard in one.recordings.values() if reads(one)]
    if not shards:
        return ""
    published = all(provenance.published(one, PAPERS_SETS) for one in datasets)
    sensors = ordered({str(shard.attributes.get("sensor", "")) for shard in shards})
    parts = [_counts([shard for shard in shards if shard.attributes.get("sensor", "") == one], one) for one in sensors]
    drawn = []
    for sensor in sensors:
        held = [one for one in shards if one.attributes.get("sensor", "") == sensor and PROFILE in one.streams]
        if held:
            drawn.append(_figures(typical(held), sensor, published))
    return f"<h3>The slides</h3>{markup.note(' '.join(parts))}{''.join(drawn)}"


def typical(shards: Sequence[Recording]) -> Recording:
    """Return the slide of median force among those that kept to the protocol, or among all where none did."""
    kept = [one for one in shards if not one.attributes.get("outside_protocol")] or list(shards)

    def force(shard: Recording) -> tuple[float, str]:
        return float(shard.attributes.get("force_n") or 0.0), shard.name

    return sorted(kept, key=force)[len(kept) // 2]


def _counts(shards: Sequence[Recording], sensor: str) -> str:
    """Return how many slides there are of a sensor, and how many kept to the protocol."""
    outside = [one for one in shards if one.attributes.get("outside_protocol")]
    some = f"{len(shards):,} slide{'s' if len(shards) > 1 else ''}"
    if not any("outside_protocol" in one.attributes for one in shards):
        return f"{some} of {shown(sensor)}."
    text = f"{some} of {shown(sensor)}, {len(outside):,} of them outside the protocol"
    reasons = Counter(str(one.attributes.get("outside_protocol_why", "")) for one in outside)
    described = [f"{count} {reason}" for reason, count in reasons.most_common() if reason]
    return text + (f" ({listed(described)})." if described else ".")


def _figures(shard: Recording, sensor: str, published: bool) -> str:
    """Return force and speed of one slide."""
    table = shard.table(PROFILE)
    time_ns = table["t_ns"].to_numpy()
    time_s = (time_ns - time_ns[0]) / 1e9
    during = table["phase"].to_numpy() == 0
    drawn = []
    force = {"force": table["force_n"].to_numpy()} if "force_n" in table.column_names else {}
    if force and np.isfinite(force["force"]).any():
        svg = figures.profile(time_s, force, during, "force (N)", f"Force over a slide, {shown(sensor)}")
        text = f"force on {shown(sensor)} in {shard.name}, the slide of median force."
        caption = wording.form("Figure 5", text, published)
        drawn.append(markup.figure(svg, f"{caption} Shaded: the slide."))
    names = {"speed_raw_m_s": "as measured", "speed_m_s": "median of 3"}
    speed = {label: 1000 * table[name].to_numpy() for name, label in names.items() if name in table.column_names}
    speed = {label: values for label, values in speed.items() if np.isfinite(values).any()}
    if speed:
        svg = figures.profile(time_s, speed, during, "speed (mm/s)", f"Speed over a slide, {shown(sensor)}")
        text = f"speed in the same slide, {listed(list(speed))}."
        drawn.append(markup.figure(svg, wording.form("Figure 6", text, published)))
    return f'<div class="pair">{"".join(drawn)}</div>'
