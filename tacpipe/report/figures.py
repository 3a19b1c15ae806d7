"""Figures as inline SVG: the same numbers give the same bytes, and colours follow the page's theme.

matplotlib draws with marker colours, which are then replaced by the page's CSS variables; ids that nothing refers to
and all metadata are taken out.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.floating[Any]]

INK, FAINT = "#010203", "#010204"
COLOURS = {"model": "#010301", "persistence": "#010302", "codec": "#010303", "other": "#010304"}
_THEME = {INK: "currentColor", FAINT: "var(--faint)", **{hexes: f"var(--{name})" for name, hexes in COLOURS.items()}}
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # text stays text
    "font.family": "sans-serif",
    "font.sans-serif": ["system-ui", "DejaVu Sans"],
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "grid.color": FAINT,
    "grid.linewidth": 0.5,
}


def errors_by_horizon(errors: Mapping[str, Sequence[float]], horizon_ms: Sequence[float], unit: str) -> str:
    """Return a figure of each predictor's error over the time ahead; ``errors`` is by predictor, one value a step."""

    def draw(axes: list[Axes]) -> None:
        others = iter(("--", "-.", ":", (0, (1, 3))))
        for name, values in errors.items():
            known = name in COLOURS
            line: dict[str, Any] = {"linewidth": 2} if known else {"linewidth": 1.2, "linestyle": next(others, ":")}
            colour = COLOURS[name if known else "other"]
            axes[0].plot(horizon_ms, values, color=colour, marker="o", markersize=3, label=name, **line)
        axes[0].set_ylim(bottom=0)
        axes[0].set_xlabel("time ahead (ms)")
        axes[0].set_ylabel(unit)
        axes[0].grid(axis="y")
        axes[0].legend()

    return _svg(draw, "Error of each predictor by time ahead", size=(5.4, 3.4))


def skill_by_horizon(skill: Mapping[str, Sequence[float]], horizon_ms: Sequence[float]) -> str:
    """Return a figure of skill over persistence and its interval; ``skill`` has mean, low, high, one value a step."""

    def draw(axes: list[Axes]) -> None:
        mean, low, high = (np.array(skill[name]) for name in ("mean", "low", "high"))
        axes[0].axhline(0, color=COLOURS["persistence"], linewidth=2)
        axes[0].fill_between(horizon_ms, low, high, color=COLOURS["model"], alpha=0.2, linewidth=0)
        axes[0].plot(horizon_ms, mean, color=COLOURS["model"], marker="o", markersize=3, linewidth=2)
        axes[0].set_xlabel("time ahead (ms)")
        axes[0].set_ylabel("skill (above 0: better than persistence)")
        axes[0].grid(axis="y")

    return _svg(draw, "Skill over persistence by time ahead, with 95 % interval", size=(5.4, 3.4))


def skill_by_trial(skill: Sequence[float], windows: Sequence[int]) -> str:
    """Return a figure with one dot a recording, sorted by skill; the dot's area grows with its windows."""

    def draw(axes: list[Axes]) -> None:
        order = np.argsort(skill, kind="stable")
        area = 12 + 60 * np.array(windows)[order] / max(windows)
        axes[0].axhline(0, color=COLOURS["persistence"], linewidth=2)
        axes[0].scatter(range(len(order)), np.array(skill)[order], s=area, color=COLOURS["model"], linewidth=0)
        axes[0].set_xticks([])
        axes[0].set_xlabel(f"{len(order)} recordings, sorted")
        axes[0].set_ylabel("skill")
        axes[0].grid(axis="y")

    return _svg(draw, "Skill over persistence of each recording", size=(5.4, 3.0))


def traces(time_s: Floats, truth: Mapping[str, Floats], ahead: Mapping[str, Mapping[str, Floats]]) -> str:
    """Return one panel a latent: the truth (time,) and what was predicted for later at the time it was known.

    ``ahead`` is by latent, then by label (``t+5``). NaN breaks a line.
    """

    def draw(axes: list[Axes]) -> None:
        for panel, (name, values) in zip(axes, truth.items(), strict=True):
            panel.plot(time_s, values, color=INK, linewidth=1.6, label="truth now")
            for number, (label, predicted) in enumerate(ahead[name].items()):
                alpha = 0.4 + 0.6 * number / max(len(ahead[name]) - 1, 1)
                panel.plot(time_s, predicted, color=COLOURS["model"], linewidth=1, alpha=alpha, label=label)
            panel.set_title(name)
        axes[0].legend(ncols=4, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0)
        axes[-1].set_xlabel("time at which the prediction is known (s)")

    return _svg(draw, "Predictions beside the truth", size=(11, 1.9 * len(truth)), panels=len(truth))


def losses(history: Sequence[Mapping[str, Any]]) -> str:
    """Return a figure of training and validation loss by epoch, from the lines of ``history.jsonl``."""

    def draw(axes: list[Axes]) -> None:
        epochs = [line["epoch"] for line in history]
        best = min(history, key=lambda line: line["val_loss"])
        axes[0].plot(epochs, [line["train_loss"] for line in history], color=COLOURS["other"], label="training")
        axes[0].plot(epochs, [line["val_loss"] for line in history], color=COLOURS["model"], label="validation")
        axes[0].plot([best["epoch"]], [best["val_loss"]], "o", color=COLOURS["model"], label="kept")
        axes[0].set_yscale("log")
        axes[0].set_xlabel("epoch")
        axes[0].set_ylabel("loss (scaled latents)")
        axes[0].grid(axis="y")
        axes[0].legend()

    return _svg(draw, "Training and validation loss by epoch", size=(5.4, 3.0))


def _svg(draw: Callable[[list[Axes]], None], title: str, size: tuple[float, float], panels: int = 1) -> str:
    """Return what ``draw`` puts on the panels, as an ``<svg>`` element."""
    import matplotlib
    from matplotlib.figure import Figure

    content = io.StringIO()
    with matplotlib.rc_context({**_STYLE, "svg.hashsalt": title}):
        figure = Figure(figsize=size, layout="constrained")
        grid = figure.subplots(panels, 1, sharex=True, squeeze=False)
        draw(list(grid[:, 0]))
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(content, format="svg", transparent=True, metadata=nothing)
    drawn = re.sub(r"<metadata>.*?</metadata>", "", content.getvalue(), flags=re.DOTALL)
    drawn = drawn[drawn.index("<svg") :]
    wanted = set(re.findall(r"#([\w-]+)[\")]", drawn))
    drawn = re.sub(r' id="([\w.-]+)"', lambda found: found[0] if found[1] in wanted else "", drawn)
    for colour, variable in _THEME.items():
        drawn = drawn.replace(colour, variable)
    return drawn.replace("<svg", f'<svg role="img" aria-label="{title}"', 1)
