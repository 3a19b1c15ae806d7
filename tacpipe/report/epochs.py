"""What changes over the epochs of training, drawn as a line a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.report.drawing import COLOURS, STYLES, legend_below, svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def by_epoch(
    runs: Mapping[str, Sequence[Sequence[float]]],
    quantity: str,
    title: str,
    order: Sequence[str] = (),
    *,
    log: bool = False,
) -> str:
    """Return a figure with a thin line a run, one value an epoch, and the mean over the runs of each name.

    The mean ends where the first of its runs does. NaN breaks a line. Figures with the same ``order`` of names give a
    name the same line.
    """

    def draw(axes: list[Axes]) -> None:
        names = list(order) or list(runs)
        for name, curves in runs.items():
            line, colour = STYLES[names.index(name) % len(STYLES)]
            if len(curves) > 1:
                for curve in curves:
                    epochs = np.arange(1, len(curve) + 1)
                    axes[0].plot(epochs, curve, color=COLOURS[colour], linewidth=0.6, alpha=0.35)
            length = min(map(len, curves))
            mean = np.mean([curve[:length] for curve in curves], axis=0)
            label = f"{name} ({len(curves)} run{'s' if len(curves) > 1 else ''})"
            epochs = np.arange(1, length + 1)
            axes[0].plot(epochs, mean, color=COLOURS[colour], linestyle=line, linewidth=1.8, label=label)
        if log:
            axes[0].set_yscale("log")
        axes[0].set_xlabel("epoch")
        axes[0].set_ylabel(quantity)
        axes[0].grid(axis="y")
        legend_below(axes[0])

    return svg(draw, title, size=(5.4, 3.2 + 0.2 * len(runs)))
