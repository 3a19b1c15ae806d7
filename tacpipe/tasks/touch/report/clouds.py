"""Clouds with the grasps made on them, drawn where a dataset of grasps is given next to results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.report import charts
from tacpipe.report.blocks import Chart, Charts, Fold, Note, fold

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Recording

CLOUD, GRASP = "cloud", "grasp"
SHOWN = 3
NEAR_MM = 10.0  # of a grasp point: about where a fingertip of 6.7 mm radius lies
POINTS = 700  # of a cloud that are drawn
VIEWS = {"from the camera": 0, "from the side": 2}  # which coordinate runs across; down is y in both
NOTE = (
    "Blue points lie near the first contact, orange ones near the second. What the camera did not see is not in the cloud, "
    "though a finger may touch it."
)


def reads(dataset: Dataset) -> bool:
    """Return whether a dataset holds clouds with grasps."""
    return any(_whole(shard) for shard in dataset.recordings.values())


def folds(datasets: Sequence[Dataset], chosen: Mapping[str, str]) -> list[Fold]:
    """Return the clouds of ``chosen`` grasps, stated with the words next to their names; nothing without any dataset.

    Where none of them is there, the first grasps are drawn.
    """
    shards = {name: shard for one in datasets for name, shard in one.recordings.items() if _whole(shard)}
    if not shards:
        return []
    first = dict.fromkeys(sorted(shards)[:SHOWN], "")
    described = {name: words for name, words in chosen.items() if name in shards} or first
    drawn = [_chart(shards[name], words) for name, words in described.items()]
    return fold("Clouds and their grasps", Charts(drawn), Note(NOTE))


def _whole(shard: Recording) -> bool:
    return {CLOUD, GRASP} <= set(getattr(shard, "streams", ()))


def _chart(shard: Recording, words: str) -> Chart:
    cloud, grasp = Cloud.of(shard.table(CLOUD)), Grasp.of(shard.table(GRASP))
    contacts_m = np.array([grasp.g1_m, grasp.g2_m])
    middle = contacts_m.mean(axis=0)
    kept = np.unique(np.linspace(0, len(cloud) - 1, POINTS).astype(int))
    points = 1000 * (cloud.points_m[kept].astype(np.float64) - middle)  # (point, xyz), mm
    contacts = 1000 * (contacts_m - middle)
    distance = np.linalg.norm(points[:, None] - contacts[None], axis=2)  # (point, finger)
    near = np.where(distance.min(axis=1) <= NEAR_MM, np.array([1, -1])[distance.argmin(axis=1)], 0)
    rows = [
        {
            "panel": view,
            "x": float(round(point[across], 1)),
            "y": float(round(-point[1], 1)),
            "strength": 0.6 * int(side),
        }
        for view, across in VIEWS.items()
        for point, side in zip(points, near, strict=True)
    ]
    rows += [
        {"panel": view, "x": float(point[across]), "y": float(-point[1]), "strength": side}
        for view, across in VIEWS.items()
        for point, side in zip(contacts, (1.0, -1.0), strict=True)
    ]
    about = f"{shard.name}{f' ({words})' if words else ''}: {shard.attributes.get('object', 'an object')}"
    caption = f"{len(cloud):,} points, the fingers {1000 * grasp.opening_m:.0f} mm apart."
    return Chart(about, charts.plane(rows, list(VIEWS), size=9), caption)
