"""A picture of a cloud with the grasps that could be made on it."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import Floats
from tacpipe.clouds.candidates import Candidate
from tacpipe.clouds.cloud import Cloud
from tacpipe.io.files import readable_errors, write_whole
from tacpipe.plugins import extras

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

G1, G2 = "#d55e00", "#0072b2"  # distinguished by eyes that do not distinguish red from green
GREY, GROUND = "#707070", "#ececec"  # of points without colours; behind all points, so that white ones are seen


def draw(cloud: Cloud, found: Sequence[Candidate], path: Path) -> None:
    """Write a picture to ``path``: the cloud in its colours from two sides, each grasp a line, its rank next to g1.

    The ending states the format: .pdf, .png or .svg. Raises `TacpipeError` if matplotlib is not installed or the file
    cannot be written.
    """
    with extras.explain_missing("A picture"):
        import matplotlib
        from matplotlib.figure import Figure

    with matplotlib.rc_context({"svg.hashsalt": "candidates"}):
        figure = Figure(figsize=(11, 6), layout="constrained", dpi=150)
        above, side = figure.subplots(1, 2)
        _panel(above, cloud, found, (0, 1), ranks=True)
        above.set_title("as the camera sees it", loc="left")
        _panel(side, cloud, found, (_width(found), 2), ranks=False)
        side.set_title("from the side", loc="left")
        figure.legend(*_legend(), loc="outside lower center", ncols=2, frameon=False)
        content, kind = io.BytesIO(), path.suffix.lower()[1:]
        bare = {"png": ("Software",), "svg": ("Date", "Creator"), "pdf": ("CreationDate", "Creator", "Producer")}[kind]
        figure.savefig(content, format=kind, metadata=dict.fromkeys(bare))  # the same grasps give the same bytes
    with readable_errors(path.parent):
        write_whole(str(path), content.getvalue(), f"{path}.draft")


def _width(found: Sequence[Candidate]) -> int:
    """Return along which of x and y the best grasp closes more: seen along the other one, it shows its depth."""
    return int(np.argmax(np.abs(found[0].grasp.closing[:2]))) if found else 0


def _panel(axes: Axes, cloud: Cloud, found: Sequence[Candidate], shown: tuple[int, int], *, ranks: bool) -> None:
    """Draw a cloud and its grasps on two of the axes x, y, z, in millimetres, the second downwards as in a picture."""
    right, down = shown
    behind = 3 - right - down  # the axis that is looked along
    order = np.argsort(-cloud.points_m[:, behind], kind="stable")  # what lies in front is drawn last
    axes.set_facecolor(GROUND)
    points_mm = cloud.points_m[order] * 1e3
    colours = GREY if cloud.colours is None else cloud.colours[order] / 255
    axes.scatter(points_mm[:, right], points_mm[:, down], c=colours, s=3, linewidths=0, rasterized=True)
    for rank, candidate in reversed(list(enumerate(found, 1))):  # the best lies on top
        ends_mm = np.stack([candidate.grasp.g1_m, candidate.grasp.g2_m]) * 1e3  # (finger, xyz)
        _line(axes, ends_mm[:, [right, down]], rank, named=ranks)
    axes.set_aspect("equal")
    axes.invert_yaxis()
    axes.set_xlabel(f"{'xyz'[right]} (mm)")
    axes.set_ylabel(f"{'xyz'[down]} (mm)")


def _line(axes: Axes, ends_mm: Floats, rank: int, *, named: bool) -> None:
    faint = 1.0 if rank == 1 else 0.75
    axes.plot(*ends_mm.T, color="white", linewidth=3.5 if rank == 1 else 2.5, alpha=faint)  # a rim, seen on any colour
    axes.plot(*ends_mm.T, color="black", linewidth=2 if rank == 1 else 1, alpha=faint)
    for end, colour in zip(ends_mm, (G1, G2), strict=True):
        axes.plot(*end, "o", color=colour, markeredgecolor="white", markersize=8 if rank == 1 else 6)
    if not named:
        return
    axes.annotate(
        str(rank), ends_mm[0], (-9, 0), textcoords="offset points", ha="right", va="center", fontsize=9,
        bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
    )  # fmt: skip


def _legend() -> tuple[list[Artist], list[str]]:
    from matplotlib.lines import Line2D

    return [Line2D([], [], marker="o", linestyle="", color=colour) for colour in (G1, G2)], ["g1", "g2"]
