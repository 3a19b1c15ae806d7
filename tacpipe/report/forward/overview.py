"""Many results next to each other: the part of the page that comes before single ones."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.metrics import headline as headline_of
from tacpipe.metrics.forecast import Interval
from tacpipe.metrics.headline import Headline, counted
from tacpipe.report import headline_box, markup, provenance
from tacpipe.report.forward import comparison, figures, representations, sweep, tables, traces
from tacpipe.report.forward import methods as by_method
from tacpipe.report.forward.comparison import Row
from tacpipe.report.forward.error_sums import BASELINE, MODEL
from tacpipe.report.forward.methods import Method, Run
from tacpipe.tasks.forward import units

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

LINES = 4  # methods in a figure of skill, the paper's not counted
FIGURE_STEPS = (3, 5, 10)  # those of the paper's figures 5 and 6
FLOOR = -1.0  # skill at which figures end
PAPERS_SETS = ("xela-flat",)  # whose paper's tables and figures stand next to ours


class Overview:
    """What the results of one page have in common, sorted for reporting."""

    def __init__(self, runs: Sequence[Run]) -> None:
        self.methods = by_method.grouped(runs)
        self.timeline = by_method.main_timeline(runs)
        self.main = [one for one in self.methods if one.timeline == self.timeline]
        self.steps = comparison.shown_steps(runs)
        known = np.concatenate([run.errors.known for method in self.main for run in method.runs])
        named = any(run.errors.named for method in self.main for run in method.runs)
        self.parts: list[bool | None] = [part for part in (True, False) if (known == part).any()] if named else [None]
        self.rows = {part: comparison.rows(self.main, self.steps, part) for part in self.parts}
        self.published = all(provenance.published(run.dataset, PAPERS_SETS) for run in runs)
        self.paper = by_method.papers(self.main) if self.published else None

    def best(self) -> Method | None:
        """Return the method that does best on unseen objects, or on known ones where there are no others."""
        row = comparison.best(self.rows[self.parts[-1]])
        return row.method if row else None

    def headlines(self) -> dict[bool | None, Headline]:
        """Return how the best method compares with its baselines, on known objects, unseen ones or all."""
        found = {}
        for part in self.parts:
            row = comparison.best(self.rows[part])
            described = comparison.headline(row.method, self.main, self.steps, part) if row else None
            if described:
                found[part] = described
        return found

    def representative_runs(self) -> list[Run]:
        """Return the runs that are worth a section of their own: of the best method and the paper's, a median one."""
        chosen = dict.fromkeys(one.name for one in (self.best(), self.paper) if one)
        return [self.median(method) for name in chosen for method in self.methods if method.name == name]

    def row_of(self, method: Method, part: bool | None) -> Row | None:
        """Return a method's row on known or unseen objects."""
        return next((row for row in self.rows[part] if row.predictor == MODEL and row.method is method), None)

    def median(self, method: Method) -> Run:
        """Return the run whose mean skill is in the middle, of an even number the one below."""
        scored = []
        for index, run in enumerate(method.runs):
            pooled = comparison.pool([run], MODEL)
            score = float(comparison.skill(pooled, self.steps).mean[-1]) if pooled else float("-inf")
            scored.append((score, index))
        return method.runs[sorted(scored)[(len(scored) - 1) // 2][1]]


def render(overview: Overview, codecs: Sequence[sweep.Tree], simulated: bool) -> str:
    """Return the comparison of all results."""
    found = overview.headlines()
    badge = ' <span class="badge">simulated</span>' if simulated else ""
    runs = sum(len(one.runs) for one in overview.methods)
    parts = [
        f"<h2>{len(overview.methods)} methods in {runs} results{badge}</h2>",
        headline_box.box(headline(overview)),
        headline_box.table(list(found.values())),
        markup.note(_basis(overview, simulated)),
        _skill_figures(overview),
        _representations(overview),
        _comparable(overview),
        _ablations(overview),
        tables.anticipation(overview.main),
        _paper_traces(overview) if overview.published else "",
        representations.section(codecs, overview.published),
    ]
    return "\n".join(part for part in parts if part) + "\n"


def headline(overview: Overview) -> list[tuple[str, str]]:
    """Return how the best method compares with the best baseline and persistence, a sentence a part, and its verdict."""
    statements = []
    averaged = _steps(overview.steps)
    for part, found in overview.headlines().items():
        row = comparison.best(overview.rows[part])
        assert row is not None  # it is what the headline is of
        described = (
            f"{headline_of.sentence(found)} Over persistence it has {_skill_text(row)}, averaged over {averaged}"
        )
        paper = overview.row_of(overview.paper, part) if overview.paper else None
        if paper is row:
            described += "; it is the paper's method"
        elif paper:
            described += f"; the paper's method, {paper.name}, has {_skill_text(paper)}"
        if row.standard_skill is not None:
            described += (
                f". With every channel in units of its standard deviation in training, {_skill(row.standard_skill)}"
            )
        statements.append((f"{described}.", found.verdict))
    return statements


def _basis(overview: Overview, simulated: bool) -> str:
    """Return what the comparison rests on."""
    settings = "; ".join(f"{name} {values}" for name, values in tables.settings(overview.methods).items())
    windows = []
    for part in overview.parts:
        pools = [row.pool for row in overview.rows[part] if row.predictor == MODEL]
        recordings = len({name for pool in pools for name in pool.recordings})
        most = max((pool.distinct_windows for pool in pools), default=0)
        of = f" of {tables.OBJECTS[part]}" if part is not None else ""
        windows.append(f"{headline_of.counted(recordings, 'recordings')}{of} ({most:,} windows)")
    unit = units.common(method.config for method in overview.methods)
    runs = [run for method in overview.methods for run in method.runs]
    known: dict[str, set[bool]] = {}
    for run in runs:
        for name, one in zip(run.errors.recordings, run.errors.known, strict=True):
            known.setdefault(name, set()).add(bool(one))
    both = any(len(one) > 1 for one in known.values())
    text = [
        f"Evaluated on {' and '.join(windows)}, none of which its model was trained on"
        f"{'; objects of some recordings are known to one run and unseen to another' if both else ''}.",
        f"Settings: {settings}." if settings else "",
        f"Skill over persistence is 1 − squared error / squared error of persistence, both in {unit} over all channels.",
        "Intervals are 95 %, from drawing whole recordings anew.",
        "In tables, the errors of a recording in several runs are kept together; the sd over runs is about other seeds."
        if any(len(method.runs) > 1 for method in overview.methods)
        else "",
        "The best of several methods was picked on these very recordings, which flatters it a little."
        if len(overview.methods) > 1
        else "",
        "The recorded motion represents the plan: errors of methods that read it hold for an arm that follows its plan "
        "perfectly."
        if any(method.actions == "planned" for method in overview.methods)
        else "",
        "These recordings were simulated: nothing here is evidence about a real sensor." if simulated else "",
    ]
    return " ".join(filter(None, text))


def _representations(overview: Overview) -> str:
    """Return the recurrent models' errors in their own spaces, next to what the paper printed where these are its data."""
    found = tables.representations(overview.main, overview.published)
    if not found:
        return ""
    text = (
        "Each row is in its own representation's space, scaled to ±1 on the training recordings. Rows of different spaces "
        "cannot be compared: a space that leaves out what is hard to predict has the lower error. Persistence in the same "
        "space states what a row is worth: below 1 in the column next to it, the model is better."
    )
    if overview.published:
        text += " The paper's own recordings are not public; its numbers are given as printed."
    title = "The paper's table" if overview.published else "Representations in their own spaces"
    return f"<h3>{title}</h3>{found}{markup.note(text)}"


def _skill_text(row: Row) -> str:
    """Return a row's mean skill and its interval in words."""
    return _skill(row.skill)


def _skill(found: Interval) -> str:
    """Return the last of some skills, their mean, and its interval in words."""
    mean, low, high = (float(getattr(found, name)[-1]) for name in ("mean", "low", "high"))
    interval = (
        "" if np.isnan([low, high]).any() else f" (95 % interval {markup.decimals(low)} to {markup.decimals(high)})"
    )
    return f"skill {markup.decimals(mean)}{interval}"


def _steps(steps: Sequence[int]) -> str:
    """Return steps in words.

    >>> _steps((1, 3, 10)), _steps((1,))
    ('t+1, t+3 and t+10', 't+1')
    """
    names = [f"t+{step}" for step in steps]
    return " and ".join(part for part in (", ".join(names[:-1]), names[-1]) if part)


def _skill_figures(overview: Overview) -> str:
    """Return the skill by step of the best methods, the paper's and the best baseline, a figure a kind of objects."""
    drawn = []
    chosen = {part: _chosen(overview, part, LINES) for part in overview.parts}
    order = list(dict.fromkeys(row.name for rows in chosen.values() for row in rows))
    for part, rows in chosen.items():
        lines: dict[str, dict[str, Sequence[float]]] = {}
        cut = []
        for row in rows:
            found = comparison.skill(row.pool, row.pool.steps)
            lines[row.name] = {name: getattr(found, name)[:-1].tolist() for name in ("mean", "low", "high")}
            if float(np.nanmin(found.mean)) < FLOOR:
                cut.append(row.name)
        steps = min((row.pool.steps for row in rows), key=len)
        short = {
            name: {key: values[: len(steps)] for key, values in described.items()} for name, described in lines.items()
        }
        rate_hz = float(rows[0].method.config.get("rate_hz") or 0)
        ahead = [1000 * step / rate_hz if rate_hz else float(step) for step in steps]
        caption = f"Skill on {tables.OBJECTS[part]} over the time ahead, with 95 % intervals over recordings."
        if cut:
            caption += f" The figure ends at {markup.skill(FLOOR)}, above some of {' and '.join(cut)}."
        svg = figures.skill_of_methods(short, ahead, "ms" if rate_hz else "steps", order, FLOOR)
        drawn.append(markup.figure(svg, caption))
    return f'<div class="pair">{"".join(drawn)}</div>'


def _chosen(overview: Overview, part: bool | None, count: int) -> list[Row]:
    """Return the rows of the ``count`` best methods, of the paper's and of the best baseline that sees no future."""
    rows = overview.rows[part]
    found = [row for row in rows if row.predictor == MODEL][:count]
    paper = overview.row_of(overview.paper, part) if overview.paper else None
    if paper and all(paper is not row for row in found):
        found.append(paper)
    plain = [row for row in rows if row.predictor != BASELINE and not comparison.own(row.predictor)]
    return found + plain[:1]


def _comparable(overview: Overview) -> str:
    """Return the tables in which all methods and baselines can be compared, and those of the best by channel."""
    source = by_method.reference(overview.main)
    unit = units.common(method.config for method in overview.methods)
    parts = [
        f"<h3>All in {escape(unit)}</h3>",
        markup.note(
            f"Every representation is decoded to {unit} of all channels before it is evaluated, so all rows can be "
            f"compared. Baselines, in grey, are those of {counted(len(source.runs), 'runs')} of {source.name}; those of a "
            f"codec are given for each, and codec and codec_anchored know the true future. Errors without a step are "
            f"means over all steps."
        ),
    ]
    parts += [tables.comparable(overview.rows[part], overview.steps, part) for part in overview.parts]
    for part in overview.parts:
        first, paper = comparison.best(overview.rows[part]), overview.paper
        row = overview.row_of(paper, part) if paper else None
        chosen = [one for one in (first, row if row is not first else None) if one]
        if chosen:
            parts.append(tables.channel_groups(chosen, overview.steps, part))
    others = sorted({one.timeline for one in overview.methods} - {overview.timeline})
    for timeline in others:
        methods = [one for one in overview.methods if one.timeline == timeline]
        parts.append(f"<h3>On the {escape(timeline)} timeline, whose steps last differently</h3>")
        for known in overview.parts:
            rows = comparison.rows(methods, overview.steps, known)
            parts.append(tables.comparable(rows, overview.steps, known))
    return "\n".join(parts)


def _ablations(overview: Overview) -> str:
    """Return what the plan and the timeline change."""
    found = [
        tables.actions(overview.methods, overview.steps, overview.parts),
        tables.timelines(overview.methods, overview.steps, overview.parts),
    ]
    described = (
        "Differences are paired: each resample draws the same recordings for both. An interval above 0 states that the "
        "plan helps."
    )
    return f"<h3>Ablations</h3>{markup.note(described)}{''.join(found)}" if any(found) else ""


def _paper_traces(overview: Overview) -> str:
    """Return Figures 5 and 6 of the paper: the first two components, and the second and fourth latent of AE-C1."""
    wanted = (
        ("PCA", (0, 1), "Figure 5 in the paper's form: the first two principal components"),
        ("AE-C1", (1, 3), "Figure 6 in the paper's form: the second and the fourth latent of AE-C1"),
    )
    drawn = []
    for row, latents, title in wanted:
        found = [
            one
            for one in overview.main
            if one.recurrent and one.actions == "planned" and by_method.paper_row(one.codec) == row
        ]
        if not found:
            continue
        run = overview.median(found[0])
        name = _median_recording(run.dataset)
        svg = traces.draw(run.dataset.recordings[name], latents, FIGURE_STEPS) if name else ""
        if svg:
            caption = f"{title}, on {name}, the recording of median skill of {found[0].name}. {traces.UNSHIFTED}"
            drawn.append(markup.figure(svg, caption))
    return f"<h3>The paper's figures</h3>{''.join(drawn)}" if drawn else ""


def _median_recording(result: Dataset) -> str | None:
    """Return the recording of median skill among those that the model has not seen."""
    trials: list[dict[str, Any]] = list(csv.DictReader(io.StringIO(result.files.get("trials.csv", b"").decode())))
    ranked = sorted(
        (float(one["skill"]), one["recording"])
        for one in trials
        if one["seen"] == "false" and one["skill"] and one["recording"] in result.recordings
    )
    return ranked[len(ranked) // 2][1] if ranked else None
