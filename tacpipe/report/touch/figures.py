"""The figures of touch: true next to predicted readings, errors of settings, and clouds with their grasps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.comparison.spread import Spread
from tacpipe.report.drawing import COLOURS, FAINT, INK, hue, legend_below, svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NEAR_MM = 10.0  # of a grasp point: about where a fingertip of 6.7 mm radius lies
POINTS = 1000  # of a cloud that are drawn
VIEWS = {"from the camera": 0, "from the side": 2}  # which coordinate runs across; down is y in both
GAP_MM = 25.0  # between views
BAR_MM = 20.0


@dataclass(frozen=True)
class Scattered:
    """True and predicted values of one object's grasps."""

    name: str
    novel: bool
    true: AnyFloats  # (grasp,)
    predicted: AnyFloats  # (grasp,)


def scatter(objects: Sequence[Scattered], constant: float, quantity: str, title: str) -> str:
    """Return predicted over true values, a colour an object; novel ones are hollow. The line is where both are the same."""

    def draw(axes: list[Axes]) -> None:
        values = np.concatenate([[constant], *(part for one in objects for part in (one.true, one.predicted))])
        ends = np.array([values.min(), values.max()])
        axes[0].plot(ends, ends, color=INK, linewidth=0.8)
        if not np.isnan(constant):
            axes[0].axhline(constant, color=FAINT, linewidth=1.2, linestyle=(0, (1, 2)), label="constant")
        for number, one in enumerate(objects):
            colour = hue(number, len(objects))
            inks = ("none", colour) if one.novel else (colour, "none")
            faces: dict[str, Any] = dict(zip(("facecolors", "edgecolors"), inks, strict=True))
            label = f"{one.name} (novel)" if one.novel else one.name
            axes[0].scatter(one.true, one.predicted, s=14, linewidth=0.9, alpha=0.75, label=label, **faces)
        axes[0].set(xlabel=f"true {quantity}", ylabel=f"predicted {quantity}", aspect="equal")
        legend_below(axes[0], columns=3)

    return svg(draw, title, size=(5.4, 5.0 + 0.07 * len(objects)))


def settings(errors: Mapping[str, Spread], levels: Mapping[str, float], title: str) -> str:
    """Return the RMSE of each setting with its standard deviation over runs; ``levels`` are drawn across."""

    def draw(axes: list[Axes]) -> None:
        places = np.arange(len(errors))
        means = np.array([one.mean for one in errors.values()])
        sds = np.nan_to_num([one.sd for one in errors.values()])
        for (name, level), line in zip(levels.items(), ("-", "--", ":"), strict=False):
            axes[0].axhline(level, color=COLOURS["persistence"], linestyle=line, linewidth=1.2, label=name)
        marks: dict[str, Any] = {"fmt": "o", "markersize": 6, "capsize": 4, "linewidth": 1.6}
        axes[0].errorbar(places, means, sds, color=COLOURS["model"], label="mean ± sd over runs", **marks)
        axes[0].set_xticks(places, labels=list(errors))
        axes[0].set(ylim=(0, None), ylabel="RMSE (fraction of the range)")
        axes[0].grid(axis="y")
        legend_below(axes[0])

    return svg(draw, title, size=(5.4, 3.4 + 0.2 * len(levels)))


def cloud(points_m: AnyFloats, contacts_m: AnyFloats, title: str) -> str:
    """Return a cloud (point, xyz) from the camera and from the side, with where two fingers touch it (finger, xyz).

    Coloured points lie near a contact. Of large clouds, evenly many are left out.
    """
    middle = contacts_m.mean(axis=0)
    points = 1000 * (points_m[np.unique(np.linspace(0, len(points_m) - 1, POINTS).astype(int))] - middle)
    contacts = 1000 * (contacts_m - middle)
    distance = np.linalg.norm(points[:, None] - contacts[None], axis=2)  # (point, finger)
    nearest = np.where(distance.min(axis=1) <= NEAR_MM, distance.argmin(axis=1), -1)
    everything = np.vstack([points, contacts])

    def draw(axes: list[Axes]) -> None:
        shift = 0.0
        for name, across in VIEWS.items():
            at = shift - everything[:, across].min()
            for part, colour in ((-1, FAINT), (0, COLOURS["model"]), (1, COLOURS["persistence"])):
                _dots(axes[0], points[nearest == part][:, [across, 1]] * np.array([1, -1]) + np.array([at, 0]), colour)
            places = contacts[:, [across, 1]] * np.array([1, -1]) + np.array([at, 0])
            axes[0].plot(*places.T, color=INK, linewidth=1, marker="o", markersize=5)
            # on either side: seen along the line between them, both contacts lie in one place
            for place, text, side in zip(places, ("g1", "g2"), (-1, 1), strict=True):
                how: dict[str, Any] = {"textcoords": "offset points", "ha": "right" if side < 0 else "left"}
                axes[0].annotate(text, place, (5 * side, 4), fontsize=9, **how)
            axes[0].annotate(name, (shift, -everything[:, 1].min()), (0, 20), textcoords="offset points", fontsize=8)
            shift += np.ptp(everything[:, across]) + GAP_MM
        below = -everything[:, 1].max() - 8
        axes[0].plot([0, BAR_MM], [below, below], color=INK, linewidth=2)
        axes[0].text(BAR_MM + 3, below, f"{BAR_MM:.0f} mm", fontsize=8, va="center")
        axes[0].set_aspect("equal")
        axes[0].axis("off")

    return svg(draw, title, size=(5.4, 3.6))


def _dots(axes: Axes, places: AnyFloats, colour: str) -> None:
    """Draw many points as one path, which a page holds in a fraction of what a mark for each would take."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    if not len(places):
        return
    ends = np.repeat(np.round(places, 1), 2, axis=0)
    ends[1::2, 0] += 0.01  # a line of no length is not drawn
    codes = np.tile([Path.MOVETO, Path.LINETO], len(places))
    axes.add_patch(PathPatch(Path(ends, codes), edgecolor=colour, linewidth=1.6, capstyle="round", fill=False))
