"""The figures of materials: curves, confusions, latents and profiles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Ints
from tacpipe.report.drawing import COLOURS, FAINT, INK, STYLES, hue, legend_below, svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes


MARKERS = ("o", "^", "s", "D")
LONGEST, LEVEL = 14, 3  # letters of a name next to an axis, and of one that lies level below it


@dataclass(frozen=True)
class Band:
    """A line of shares over the number of training slides, and the interval of each."""

    slides: Sequence[int]
    mean: Sequence[float]
    low: Sequence[float]
    high: Sequence[float]


@dataclass(frozen=True)
class Cloud:
    """Latents of one sensor's slides in two dimensions."""

    sensor: str
    points: AnyFloats  # (slide, 2)
    materials: Ints  # (slide,)
    names: Sequence[str] = ()  # of materials, where they are not their numbers

    def name(self, material: int) -> str:
        """Return what the figure calls a material."""
        return _short(self.names[material]) if self.names else str(material)


def by_slides(bands: Mapping[str, Band], chance: float, title: str, order: Sequence[str] = ()) -> str:
    """Return a figure of accuracy over the number of training slides, on a log axis, each line with its interval."""

    def draw(axes: list[Axes]) -> None:
        names = list(order) or list(bands)
        axes[0].axhline(100 * chance, color=FAINT, linewidth=1.2, linestyle=(0, (1, 2)))
        axes[0].annotate("chance", (0, 100 * chance), (3, 3), ("axes fraction", "data"), "offset points", color=FAINT)
        for name, band in bands.items():
            line, colour = STYLES[names.index(name) % len(STYLES)]
            low, high = (100 * np.array(bound) for bound in (band.low, band.high))
            axes[0].fill_between(band.slides, low, high, color=COLOURS[colour], alpha=0.15, linewidth=0)
            marks: dict[str, Any] = {"marker": "o", "markersize": 4, "linewidth": 1.8}
            fractions = 100 * np.array(band.mean)
            axes[0].plot(band.slides, fractions, color=COLOURS[colour], linestyle=line, label=name, **marks)
        shown = sorted({count for band in bands.values() for count in band.slides})
        axes[0].set_xscale("log")
        axes[0].set_xticks(_apart(shown), labels=[str(count) for count in _apart(shown)])
        axes[0].set_xticks([], minor=True)
        axes[0].set_ylim(0, 102)
        axes[0].set_xlabel("training slides")
        axes[0].set_ylabel("accuracy (%)")
        axes[0].grid(axis="y")
        legend_below(axes[0])

    return svg(draw, title, size=(5.4, 3.4 + 0.2 * len(bands)))


def confusion(counts: Ints, materials: Sequence[int | str], title: str, label: str = "material") -> str:
    """Return how often each material (row) was taken for each (column), in squares; mistakes stand as numbers."""

    def draw(axes: list[Axes]) -> None:
        from matplotlib.patches import Rectangle

        totals = np.maximum(counts.sum(axis=1), 1)
        for (row, column), count in np.ndenumerate(counts):
            if not count:
                continue
            right = row == column
            # the square root shows a single mistake next to many right ones
            strength = round(float(np.sqrt(count / totals[row])) * (0.75 if right else 0.85), 2)
            colour = COLOURS["model" if right else "persistence"]
            place = (column - 0.5, row - 0.5)
            axes[0].add_patch(Rectangle(place, 1, 1, facecolor=colour, alpha=strength, linewidth=0))
            if not right:
                axes[0].text(column, row, str(count), fontsize=7, ha="center", va="center")
        ends = (-0.5, len(materials) - 0.5)
        axes[0].set(xlim=ends, ylim=ends[::-1], aspect="equal", xlabel="named", ylabel=label)
        axes[0].spines[["top", "right"]].set_visible(True)
        for axis in (axes[0].xaxis, axes[0].yaxis):
            axis.set_ticks(range(len(materials)), labels=[_short(str(one)) for one in materials], fontsize=7)
        if max(len(_short(str(one))) for one in materials) > LEVEL:
            axes[0].tick_params(axis="x", labelrotation=90)

    return svg(draw, title, size=(4.8, 4.6))


def latents(clouds: Sequence[Cloud], partners: Mapping[int, int], title: str) -> str:
    """Return latents in two dimensions: a marker a sensor, a colour a material, whose number stands at the first's mean.

    Lines lead from there to the mean of the second sensor's slides of the material in ``partners``, or else the same one.
    """

    def draw(axes: list[Axes]) -> None:
        numbers = sorted({int(one) for cloud in clouds for one in cloud.materials})
        for cloud, marker in zip(clouds, MARKERS, strict=False):
            colours = [hue(numbers.index(int(one)), len(numbers)) for one in cloud.materials]
            filled = marker == MARKERS[0]
            for points, size, inks in ((cloud.points, 16, colours), (np.empty((0, 2)), 20, INK)):
                axes[0].scatter(
                    points[:, 0],
                    points[:, 1],
                    s=size,
                    marker=marker,
                    linewidth=0.9,
                    alpha=0.7 if len(points) else 1,
                    facecolors=inks if filled else "none",
                    edgecolors="none" if filled else inks,
                    label=None if len(points) else cloud.sensor,  # a legend in ink, not in a material's colour
                )
        means = [_means(cloud) for cloud in clouds[:2]]
        for one, middle in means[0].items():
            other = means[1].get(partners.get(one, one))
            if other is not None:
                axes[0].plot(*np.array([middle, other]).T, color=INK, linewidth=0.8, alpha=0.7)
            axes[0].text(
                middle[0], middle[1], clouds[0].name(one), fontsize=8, fontweight="bold", ha="center", va="center"
            )
        axes[0].set_xticks([])
        axes[0].set_yticks([])
        axes[0].set_xlabel("first principal component")
        axes[0].set_ylabel("second")
        axes[0].legend(ncols=2, loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0)

    return svg(draw, title, size=(5.0, 4.4))


def profile(time_s: AnyFloats, lines: Mapping[str, AnyFloats], during: Bools, quantity: str, title: str) -> str:
    """Return a recording's course over time, one line a name, with the slide shaded."""

    def draw(axes: list[Axes]) -> None:
        if during.any():
            axes[0].axvspan(*time_s[during][[0, -1]], color=FAINT, alpha=0.15, linewidth=0)
        colours = ("other", "model") if len(lines) > 1 else ("model",)
        for number, (name, values) in enumerate(lines.items()):
            last = number == len(lines) - 1
            axes[0].plot(
                time_s, values, color=COLOURS[colours[number % 2]], linewidth=1.4 if last else 0.9, alpha=1 if last else 0.7,
                label=name,
            )  # fmt: skip
        axes[0].set_xlabel("time (s)")
        axes[0].set_ylabel(quantity)
        axes[0].set_ylim(bottom=min(0.0, float(np.nanmin([np.nanmin(one) for one in lines.values()]))))
        axes[0].grid(axis="y")
        if len(lines) > 1:
            axes[0].legend()

    return svg(draw, title, size=(5.4, 3.0))


def _short(name: str) -> str:
    """Return a name that fits next to an axis."""
    return name if len(name) <= LONGEST else f"{name[: LONGEST - 1]}…"


def _apart(counts: Sequence[int]) -> list[int]:
    """Return those of sorted counts whose labels do not touch on a log axis."""
    kept: list[int] = []
    for count in reversed(counts):
        if not kept or kept[-1] / count > (counts[-1] / counts[0]) ** 0.09:
            kept.append(count)
    return kept[::-1]


def _means(cloud: Cloud) -> dict[int, AnyFloats]:
    return {int(one): cloud.points[cloud.materials == one].mean(axis=0) for one in np.unique(cloud.materials)}
