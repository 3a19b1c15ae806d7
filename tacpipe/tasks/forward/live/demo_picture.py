"""The picture of a live demonstration: the load along the skin with its forecast, the alarms, and each slip from near."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Floats, Times
from tacpipe.signals.shear import shear

GAP_PERIODS = 5.0  # without a forecast, where the line is broken
BEFORE_MS, AFTER_MS = 400.0, 150.0  # of a slip, that are shown from near
MOST_SLIPS = 6  # that are shown from near
MEASURED, PREDICTED, SLIPPED, QUIET = "#444444", "#d95f02", "#1b6ca8", "#cccccc"


def draw(
    path: Path, recording: Any, layout: Any, truth_ns: Times, slips: Bools, found: Times, horizon_ns: int, headline: str
) -> Path:
    """Draw a session against the slips of the simulation, ``found`` (event, 2), and return the path."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    start_ns = int(truth_ns[0])
    alarm = recording.table("alarm").to_pandas()
    alarm_ns = alarm["t_device_ns"].to_numpy()
    columns = max(1, min(MOST_SLIPS, len(found)))
    figure = pyplot.figure(figsize=(12, 7.5), layout="constrained")
    grid = figure.add_gridspec(3, columns, height_ratios=(2, 1, 2))
    upper = figure.add_subplot(grid[0, :])
    lower = figure.add_subplot(grid[1, :], sharex=upper)
    figure.suptitle(headline, x=0.01, ha="left")
    _loads(upper, recording.table("forecast"), layout, start_ns, horizon_ns)
    _strips(lower, alarm, (alarm_ns - start_ns) / 1e9, (truth_ns[slips] - start_ns) / 1e9)
    for axes in (upper, lower):
        for begins_ns in found[:, 0].tolist():
            axes.axvline((begins_ns - start_ns) / 1e9, color=SLIPPED, linewidth=0.6, alpha=0.6)
    nears: list[Any] = []
    for place, begins_ns in enumerate(found[:MOST_SLIPS, 0].tolist()):
        near = figure.add_subplot(grid[2, place], sharey=nears[0] if nears else None)
        nears.append(near)
        _near(near, alarm, (alarm_ns - begins_ns) / 1e6, horizon_ns / 1e6)
        near.set_title(f"slip at {(begins_ns - start_ns) / 1e9:.1f} s\n{lead_in_words(alarm, begins_ns, horizon_ns)}")
        if place == 0:
            near.set_ylabel("slip alarm's score,\nmultiples of its level")
    figure.savefig(path, dpi=120)
    pyplot.close(figure)
    return path


def lead_in_words(alarm: Any, begins_ns: int, horizon_ns: int) -> str:
    """Return by how much the slip alarm led the slip that begins at a time, of the session's stream of alarms.

    >>> import pandas
    >>> rows = pandas.DataFrame({"t_device_ns": [0, 20_000_000, 40_000_000], "slip_state": [0, 1, 1]})
    >>> lead_in_words(rows, 60_000_000, 200_000_000), lead_in_words(rows, 20_000_000, 200_000_000)
    ('led by 40 ms', 'not led')
    """
    t_ns, state = alarm["t_device_ns"].to_numpy(), alarm["slip_state"].to_numpy()
    before = (t_ns >= begins_ns - horizon_ns) & (t_ns < begins_ns)
    if not before.any() or (state[before] < 0).any():
        return "alarm unknown before"
    on = t_ns[before & (state > 0)]
    return f"led by {(begins_ns - on[0]) / 1e6:.0f} ms" if len(on) else "not led"


def _loads(axes: Any, table: Any, layout: Any, start_ns: int, horizon_ns: int) -> None:
    """Draw the shear load of the first skin one row ahead, and the largest that is predicted within the horizon."""
    names = list(dict.fromkeys(name.rpartition("_t")[0] for name in table.column_names if "_taxel" in name))
    steps = sorted({int(name.rpartition("_t")[2]) for name in table.column_names if "_taxel" in name})
    t_ns = table.column("t_device_ns").to_numpy()
    levels: Floats = np.empty((len(t_ns), len(steps), len(names)))
    for place, step in enumerate(steps):
        for channel, name in enumerate(names):
            levels[:, place, channel] = table.column(f"{name}_t{step}").to_numpy()
    pulled = shear(levels, layout)[..., 0]  # (row, step)
    at_s = (t_ns - start_ns) / 1e9
    period_s = horizon_ns / 1e9 / steps[-1]
    gaps = np.flatnonzero(np.diff(at_s) > GAP_PERIODS * period_s) + 1

    def line(values: AnyFloats, colour: str, label: str) -> None:
        broken_s, broken = (np.insert(np.asarray(one, float), gaps, np.nan) for one in (at_s, values))
        axes.plot(broken_s, broken, color=colour, linewidth=1, label=label)

    line(pulled.max(axis=1), PREDICTED, f"largest predicted of the next {horizon_ns / 1e6:.0f} ms")
    line(pulled[:, 0], MEASURED, "predicted for the next row")
    axes.set_ylabel("load along the skin\nof one finger, count")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)
    axes.tick_params(labelbottom=False)


def _strips(axes: Any, alarm: Any, alarm_s: AnyFloats, slips_s: AnyFloats) -> None:
    """Draw where alarms are on and where it slips."""
    for place, name in enumerate(("load", "slip")):
        state = alarm[f"{name}_state"].to_numpy()
        for value, colour in ((0, QUIET), (1, PREDICTED)):
            rows = alarm_s[state == value]
            axes.plot(rows, np.full(len(rows), place), "|", color=colour, markersize=12)
    axes.plot(slips_s, np.full(len(slips_s), 2), "|", color=SLIPPED, markersize=12)
    axes.set_yticks([0, 1, 2], ["load alarm (on: orange)", "slip alarm (on: orange)", "slip (truth)"])
    axes.set_ylim(-0.6, 2.6)
    axes.set_xlabel("time, s")


def _near(axes: Any, alarm: Any, since_ms: AnyFloats, horizon_ms: float) -> None:
    """Draw the score of the slip alarm around a slip."""
    shown = (since_ms >= -BEFORE_MS) & (since_ms <= AFTER_MS)
    score, state = alarm["slip_score"].to_numpy()[shown], alarm["slip_state"].to_numpy()[shown]
    at_ms = since_ms[shown]
    axes.axvspan(-horizon_ms, 0, color=QUIET, alpha=0.3, linewidth=0)
    axes.axhline(1.0, color=MEASURED, linewidth=0.8, linestyle="--")
    axes.axvline(0.0, color=SLIPPED, linewidth=1.2)
    axes.plot(at_ms, score, color=MEASURED, linewidth=1)
    axes.plot(at_ms[state > 0], score[state > 0], "o", color=PREDICTED, markersize=4)
    axes.set_xlim(-BEFORE_MS, AFTER_MS)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("ms from the slip")
    axes.tick_params(labelleft=True)
