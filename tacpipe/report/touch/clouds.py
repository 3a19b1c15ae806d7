"""Clouds with the grasps made on them, drawn where a dataset of grasps is given next to results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.report import markup
from tacpipe.report.touch import figures

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Recording

CLOUD, GRASP = "cloud", "grasp"
SHOWN = 3


def reads(dataset: Dataset) -> bool:
    """Return whether a dataset holds clouds with grasps."""
    return any(_whole(shard) for shard in dataset.recordings.values())


def section(datasets: Sequence[Dataset], chosen: Mapping[str, str]) -> str:
    """Return the clouds of ``chosen`` grasps, stated with the words next to their names; empty without any dataset.

    Where none of them is there, the first grasps are drawn.
    """
    shards = {name: shard for one in datasets for name, shard in one.recordings.items() if _whole(shard)}
    if not shards:
        return ""
    described = {name: words for name, words in chosen.items() if name in shards} or dict.fromkeys(
        sorted(shards)[:SHOWN], ""
    )
    drawn = [_figure(shards[name], words) for name, words in described.items()]
    note = (
        "Blue points lie near the first contact, orange ones near the second. What the camera did not see is not in the "
        "cloud, though a finger may touch it."
    )
    return f'<h3>Clouds and their grasps</h3><div class="pair">{"".join(drawn)}</div>{markup.note(note)}'


def _whole(shard: Recording) -> bool:
    return {CLOUD, GRASP} <= set(getattr(shard, "streams", ()))


def _figure(shard: Recording, words: str) -> str:
    cloud, grasp = Cloud.of(shard.table(CLOUD)), Grasp.of(shard.table(GRASP))
    contacts = np.array([grasp.g1_m, grasp.g2_m])
    svg = figures.cloud(cloud.points_m.astype(np.float64), contacts, f"Cloud and grasp of {shard.name}")
    about = f"{shard.name}{f' ({words})' if words else ''}: {shard.attributes.get('object', 'an object')}"
    return markup.figure(svg, f"{about}, {len(cloud):,} points, the fingers {1000 * grasp.opening_m:.0f} mm apart.")
