"""The electrodes of a BioTac SP on the skin of its fingertip, rolled out, with a value each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.channels import biotac_sp
from tacpipe.report.drawing import COLOURS, FAINT, svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes


DOT_MM = 1.1  # radius of an electrode as drawn; the nearest two lie farther apart than twice that
APART_MM = 26.0  # from one fingertip to the next
INCHES = 0.105  # of the figure, for a millimetre
_OUTLINE_MM = 10.8, -12.5, 12.5  # half width, and where the fingertip begins and ends along the finger


@dataclass(frozen=True)
class Fingertip:
    """What is drawn on one fingertip."""

    title: str
    strength: AnyFloats  # (electrode,), -1 to 1: how strongly it is coloured, below 0 in the other colour
    texts: Sequence[str]  # in each electrode


def draw(fingertips: Sequence[Fingertip], title: str) -> str:
    """Return fingertips side by side, their tips up, as seen on the pad."""

    def put(axes: list[Axes]) -> None:
        for number, one in enumerate(fingertips):
            _put(axes[0], one, number * APART_MM)
        ends = (-APART_MM / 2, (len(fingertips) - 0.5) * APART_MM)
        axes[0].set(xlim=ends, ylim=(-13.5, 17.5), aspect="equal")
        axes[0].axis("off")

    return svg(put, title, size=(INCHES * APART_MM * len(fingertips), INCHES * 31))


def _put(axes: Axes, one: Fingertip, at_mm: float) -> None:
    """Draw a fingertip about a place across."""
    from matplotlib.collections import EllipseCollection
    from matplotlib.colors import to_rgba

    half, begin, end = _OUTLINE_MM
    angle = np.linspace(0, np.pi, 40)
    across = np.concatenate([[half], half * np.cos(angle), [-half]]) + at_mm
    along = np.concatenate([[begin], (end - 2) * np.sin(angle) + 2, [begin]])
    axes.plot(across, along, color=FAINT, linewidth=1)
    places = 1000 * biotac_sp.unrolled_m()[:, ::-1] + np.array([at_mm, 0])  # (electrode, across and along), mm
    strengths = [round(float(np.clip(part, -1, 1)), 2) for part in one.strength]
    inks = [to_rgba(COLOURS["model" if part >= 0 else "persistence"], 0.85 * abs(part)) for part in strengths]
    dot = [2 * DOT_MM]
    how: dict[str, Any] = {"units": "xy", "offsets": places, "offset_transform": axes.transData}
    axes.add_collection(EllipseCollection(dot, dot, [0], facecolors=inks, edgecolors=FAINT, linewidths=0.5, **how))
    for (x, y), text in zip(places, one.texts, strict=True):
        axes.text(x, y, text, fontsize=5.5, ha="center", va="center_baseline")
    axes.text(at_mm, end + 2, one.title, fontsize=9, ha="center")
