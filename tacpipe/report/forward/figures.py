"""The figures of forecasts: errors, skill, codecs and traces."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.report.drawing import COLOURS, FAINT, INK, svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes


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

    return svg(draw, "Error of each predictor by time ahead", size=(5.4, 3.4))


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

    return svg(draw, "Skill over persistence by time ahead, with 95 % interval", size=(5.4, 3.4))


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

    return svg(draw, "Skill over persistence of each recording", size=(5.4, 3.0))


def skill_of_methods(
    skill: Mapping[str, Mapping[str, Sequence[float]]],
    ahead: Sequence[float],
    unit: str,
    order: Sequence[str] = (),
    floor: float = -1.0,
) -> str:
    """Return a figure of the skill of several methods over the time ahead, each with the band of its interval.

    ``skill`` is by method, then mean, low and high, one value a step. Figures with the same ``order`` of names give a name
    the same line. Below ``floor`` the figure ends, so that one method
    that is far worse than persistence does not press the others into one line.
    """

    def draw(axes: list[Axes]) -> None:
        axes[0].axhline(0, color=COLOURS["persistence"], linewidth=2, label="persistence")
        lines = list(itertools.product(("-", "--", ":"), ("model", "codec", "other")))
        names = list(order) or list(skill)
        for name, one in skill.items():
            line, colour = lines[names.index(name) % len(lines)]
            mean, low, high = (np.array(one[part]) for part in ("mean", "low", "high"))
            axes[0].fill_between(ahead, low, high, color=COLOURS[colour], alpha=0.15, linewidth=0)
            axes[0].plot(
                ahead, mean, color=COLOURS[colour], linestyle=line, marker="o", markersize=3, linewidth=1.8, label=name
            )
        described = [value for found in skill.values() for part in ("mean", "low", "high") for value in found[part]]
        highest, lowest = np.nanmax([0.05, *described]), max(floor, np.nanmin([0.0, *described]))
        room = 0.05 * (highest - lowest)
        axes[0].set_ylim(lowest - (room if lowest > floor else 0), highest + room)
        axes[0].set_xlabel(f"time ahead ({unit})")
        axes[0].set_ylabel("skill (above 0: better than persistence)")
        axes[0].grid(axis="y")
        axes[0].legend(loc="upper left", bbox_to_anchor=(0, -0.16), borderaxespad=0)

    return svg(draw, "Skill of methods over persistence by time ahead, with 95 % intervals", size=(5.4, 4.8))


def explained_variance(ratio: Sequence[float], kept: int) -> str:
    """Return bars of the fraction of variance that each principal component holds; those that are ``kept`` stand out."""

    def draw(axes: list[Axes]) -> None:
        numbers = np.arange(1, len(ratio) + 1)
        colours = [COLOURS["model"] if number <= kept else FAINT for number in numbers]
        axes[0].bar(numbers, 100 * np.array(ratio), color=colours, width=0.8, linewidth=0)
        axes[0].set_xlabel("principal component")
        axes[0].set_ylabel("variance (%)")
        axes[0].grid(axis="y")
        axes[0].set_axisbelow(True)

    return svg(draw, "Fraction of variance by principal component", size=(5.4, 3.4))


def covariance(matrix: AnyFloats) -> str:
    """Return a covariance matrix (latent, latent) in squares: the stronger the colour, the farther from 0."""

    def draw(axes: list[Axes]) -> None:
        from matplotlib.patches import Rectangle

        largest = float(np.abs(matrix).max()) or 1.0
        for (row, column), value in np.ndenumerate(matrix):
            # the square root shows what is small next to the first component; cells of nothing are left out
            strength = round(float(np.sqrt(abs(value) / largest)), 2)
            if strength >= 0.01:
                colour = COLOURS["model" if value > 0 else "persistence"]
                axes[0].add_patch(Rectangle((column + 0.5, row + 0.5), 1, 1, color=colour, alpha=strength, linewidth=0))
        count = len(matrix)
        axes[0].set(xlim=(0.5, count + 0.5), ylim=(count + 0.5, 0.5), aspect="equal", xlabel="latent", ylabel="latent")
        axes[0].spines[["top", "right"]].set_visible(True)
        shown = [1, *range(5, count + 1, 5)] if count > 10 else list(range(1, count + 1))
        axes[0].set_xticks(shown)
        axes[0].set_yticks(shown)

    return svg(draw, "Covariance between latents", size=(4.2, 3.8))


def loss_by_width(series: Mapping[str, Mapping[int, float]]) -> str:
    """Return a figure of reconstruction error over the number of latents; ``series`` is by kind, then by number."""

    def draw(axes: list[Axes]) -> None:
        lines = itertools.product(("-", "--", ":"), ("model", "codec", "other", "persistence"))
        for (name, losses), (line, colour) in zip(sorted(series.items()), lines, strict=False):
            widths = sorted(losses)
            values = [losses[width] for width in widths]
            axes[0].plot(widths, values, color=COLOURS[colour], linestyle=line, marker="o", markersize=4, label=name)
        axes[0].set_xticks(sorted({width for losses in series.values() for width in losses}))
        axes[0].set_ylim(bottom=0)
        axes[0].set_xlabel("latents")
        axes[0].set_ylabel("mean squared error (standardised)")
        axes[0].grid(axis="y")
        axes[0].legend()

    return svg(draw, "Reconstruction error by number of latents", size=(5.4, 3.4))


def traces(time_s: AnyFloats, truth: Mapping[str, AnyFloats], ahead: Mapping[str, Mapping[str, AnyFloats]]) -> str:
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

    return svg(draw, "Predictions next to the truth", size=(11, 1.9 * len(truth)), panels=len(truth))


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

    return svg(draw, "Training and validation loss by epoch", size=(5.4, 3.0))
