"""What codecs of several kinds and widths lose, from the ``codec.json`` of each."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

Tree = Mapping[str, Any]

FILE = "codec.json"


@dataclass(frozen=True)
class Loss:
    """What codecs of one kind and width lose on the way to latents and back, the mean over the codecs."""

    series: str  # kind and class: PCA, AE-C1, …
    latents: int
    codecs: int
    part: str  # of the training recordings: ``val``, held out of the fit, or ``train``
    mse_standardised: float
    mae_counts: float


def read(datasets: Sequence[Dataset]) -> list[Tree]:
    """Return the descriptions of the codecs among the files of ``datasets``, each one once."""
    found = dict.fromkeys(bytes(one.files[FILE]) for one in datasets if FILE in one.files)
    return [json.loads(content) for content in found]


def series(codec: Tree) -> str:
    """Return what codecs that differ in width alone are called together.

    >>> series({"kind": "autoencoder", "frames": 2, "of": "increments"})
    'AE-C2 increments'
    """
    name = f"AE-C{codec.get('frames', 1)}" if codec["kind"] == "autoencoder" else str(codec["kind"]).upper()
    return name if codec.get("of", "levels") == "levels" else f"{name} {codec['of']}"


def losses(codecs: Sequence[Tree]) -> list[Loss]:
    """Return what codecs lose by series and width, on held-out recordings if all report on these, or else on the fit's."""
    part = "val" if all("val" in one["reconstruction"] for one in codecs if one.get("reconstruction")) else "train"
    found: dict[tuple[str, int], list[Tree]] = {}
    for codec in codecs:
        if codec.get("reconstruction"):
            found.setdefault((series(codec), int(codec["latents"])), []).append(codec["reconstruction"])
    made = []
    for (name, latents), described in sorted(found.items()):
        errors = {
            measure: float(np.mean([one[part][measure] for one in described]))
            for measure in ("mse_standardised", "mae_counts")
        }
        made.append(Loss(name, latents, len(described), part, **errors))
    return made


def papers(codecs: Sequence[Tree], wanted: str, latents: int) -> Tree | None:
    """Return the first codec of a series that has a covariance, the one whose width is nearest to ``latents``."""
    held = [one for one in codecs if series(one) == wanted and one.get("latent_covariance")]
    return min(held, key=lambda one: abs(int(one["latents"]) - latents), default=None)
