"""What the page states of forecasts beyond the comparison: by time ahead, channel, plan and timeline."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.comparison.engine import Comparison, Row
from tacpipe.comparison.runs import MODEL, Method, Question, Run
from tacpipe.metrics import pairing
from tacpipe.metrics.intervals import Interval
from tacpipe.report import blocks, charts
from tacpipe.report.blocks import NONE, Cell, Chart, Charts, Fold, Note, Table, fold, number, table
from tacpipe.report.charts import Line
from tacpipe.report.context import Context
from tacpipe.tasks.forward import headline, units
from tacpipe.tasks.forward.headline import BASELINE
from tacpipe.tasks.forward.report import (
    anticipation,
    bands,
    live,
    reading,
    representations,
    representatives,
    single_run,
    situations,
    skill,
    slips,
)
from tacpipe.tasks.forward.report import methods as by_method

if TYPE_CHECKING:
    from collections.abc import Callable


Tree = Mapping[str, Any]
LINES = 4  # methods in a figure of skill, the paper's not counted
FLOOR = -1.0  # skill at which figures end
SETTINGS = ("preset", "epochs", "stride", "hidden", "batch", "seed")


def folds(context: Context) -> list[Fold]:
    """Return what forecasts have of their own."""
    if not context.comparisons:
        return representations.folds(context)
    return [
        *_ahead(context),
        *_channels(context),
        *_ablations(context),
        *bands.folds(context),
        *anticipation.folds(context),
        *slips.folds(context),
        *situations.folds(context),
        *live.folds(context),
        *representations.folds(context),
        *representatives.predictions(context),
        *representatives.training(context),
        *representatives.single(context),
    ]


def columns(context: Context, comparison: Comparison) -> list[tuple[str, Callable[[Row], Cell]]]:
    """Return more columns of the table of all methods: skill by step, and errors with channels in other units."""
    steps, known = _steps(context), _known(comparison.question)
    unit = comparison.measure.unit

    @functools.cache
    def skills(row: Row, group: str) -> Interval | None:
        sums = skill.sums_of(row, steps, known, group)
        return skill.skills(sums) if sums else None

    def squared(group: str) -> Callable[[Row], Cell]:
        return lambda row: number(skill.mse(skill.sums_of(row, _all_steps(context), known, group)))

    def at(place: int) -> Callable[[Row], Cell]:
        return lambda row: skill.cell(skills(row, "both"), place)

    def windows(row: Row) -> Cell:
        most: dict[str, int] = {}
        for run in row.method.of(comparison.question):
            errors = run.details.errors
            for name, count, one in zip(errors.recordings, errors.windows, errors.known, strict=True):
                if known is None or bool(one) == known:
                    most[name] = max(int(count), most.get(name, 0))
        return Cell(f"{sum(most.values()):,}", value=sum(most.values()))

    return [
        *((f"skill over persistence t+{step}", at(place)) for place, step in enumerate(steps)),
        ("skill over persistence, channels standardised", lambda row: skill.cell(skills(row, "standard"), -1)),
        (f"MSE ({unit}²)", squared("both")),
        ("MSE (standardised)", squared("standard")),
        ("windows", windows),
    ]


def caveats(context: Context) -> list[str]:
    """Return what must be known about these numbers."""
    runs = [run.details for run in context.runs]
    known: dict[str, set[bool]] = {}
    values: dict[str, set[Any]] = {}
    for run in runs:
        for name, one in zip(run.errors.recordings, run.errors.known, strict=True):
            known.setdefault(name, set()).add(bool(one))
        for name in SETTINGS:
            if run.config["params"].get(name) is not None:
                values.setdefault(name, set()).add(run.config["params"][name])
    settings = "; ".join(f"{name} {', '.join(map(str, sorted(one, key=str)))}" for name, one in values.items())
    counts = [run.metrics.get("counts", {}) for run in runs[:1]]
    both = "Objects of some recordings are known to one run and unseen to another."
    effective = [
        f"{one['windows']:,} windows overlap and are worth about {one['effective_windows']:,}"
        for one in counts
        if "windows" in one
    ]
    return [
        f"Settings: {settings}." if settings else "",
        *_look_ahead(context),
        "Skill over persistence is 1 − mean absolute error / mean absolute error of persistence over all channels, the "
        "geometric mean of the ratios over recordings. Every representation is decoded to the channels' own unit before it "
        "is evaluated, so all rows can be compared. Errors without a step are means over all steps.",
        f"In the first run, {effective[0]}." if effective else "",
        both if any(len(one) > 1 for one in known.values()) else "",
        "The recorded motion represents the plan: errors of methods that read it hold for an arm that follows it perfectly."
        if any(run.actions == "planned" for run in runs)
        else "",
        "; ".join(f"{single_run.spelled(name)}: {single_run.EXPLAINED[name]}" for name in _predictors(context)) + ".",
    ]  # fmt: skip


def _look_ahead(context: Context) -> list[str]:
    """Return how far the rows that models were trained on look ahead, with their methods where others do not."""
    methods: dict[str, list[str]] = {}
    for method in context.methods:
        for note in dict.fromkeys(
            note for run in method.runs for note in headline.look_ahead_notes(run.details.config)
        ):
            methods.setdefault(note, []).append(method.name)
    return [
        note if len(names) == len(context.methods) else f"{blocks.listed(names)}: {note}"
        for note, names in methods.items()
    ]


def about_run(run: Run) -> dict[str, Cell | str]:
    """Return more columns of the table of runs."""
    epochs = len(run.details.history)
    return {"epochs": str(epochs) if epochs else NONE}


def _ahead(context: Context) -> list[Fold]:
    """Return skill over the time ahead of the best methods, the paper's and the best baseline, a chart a part."""
    drawn, order = [], list[str]()
    chosen = {one: _shown(context, one) for one in context.comparisons}
    for rows in chosen.values():
        order += [row.name for row in rows if row.name not in order]
    for one, rows in chosen.items():
        config = rows[0].method.runs[0].details.config
        rate_hz = float(config.get("rate_hz") or 0)
        steps = _all_steps(context)
        x = [1000 * step / rate_hz if rate_hz else float(step) for step in steps]
        several, cut = [], []
        for row in rows:
            found = skill.skills(skill.sums_of(row, steps, _known(one.question)))
            mean, low, high = (getattr(found, name)[:-1] for name in ("mean", "low", "high"))
            several.append(Line(row.name, x, mean, low, high, dashed=row.kind != "model"))
            cut += [row.name] if float(np.nanmin(mean)) < FLOOR else []
        caption = "Bands: 95 % intervals over recordings. Dashed: a baseline. Click a name to show it alone."
        caption += f" Ends at {blocks.signed(FLOOR, 1)}, above some of {blocks.listed(cut)}." if cut else ""
        spec = charts.lines(
            several, f"time ahead ({'ms' if rate_hz else 'steps'})", "skill over persistence", order=order,
            level=("persistence", 0.0), floor=FLOOR,
        )  # fmt: skip
        drawn.append(Chart(f"Skill by time ahead: {one.question.where}", spec, caption))
    return fold("By time ahead", Charts(drawn)) if drawn else []


def _shown(context: Context, one: Comparison) -> list[Row]:
    found = one.models[:LINES]
    other = context.row(one, representatives.paper(context))
    found += [other] if other and other not in found else []
    return found + [row for row in one.of("baseline") if row.predictor != BASELINE][:1]


def _channels(context: Context) -> list[Fold]:
    """Return errors and skill by sensor and axis of the best method, of the paper's, and of persistence."""
    tables: list[Table] = []
    steps = _steps(context)
    for one in context.comparisons:
        chosen = [row for row in dict.fromkeys([one.best, context.row(one, representatives.paper(context))]) if row]
        if not chosen:
            continue
        known = _known(one.question)
        rows: list[Sequence[str | Cell]] = []
        groups = chosen[0].method.runs[0].details.errors.groups
        for group in (name for name in groups if name not in ("both", "standard", "feature", "latent")):
            for row in chosen:
                sums = skill.sums_of(row, steps, known, group)
                if sums:
                    found = skill.skills(sums)
                    cells = [
                        skill.cell(found, -1),
                        *map(number, skill.mae(sums)),
                        *(skill.cell(found, at) for at in range(len(steps))),
                    ]
                    rows.append([f"{group}, {row.name}", *cells])
            still = skill.sums(chosen[0].method, BASELINE, steps, known, group)
            if still:
                rows.append([f"{group}, {BASELINE}", NONE, *map(number, skill.mae(still)), *[NONE] * len(steps)])
        ahead = [f"t+{step}" for step in steps]
        heads = [
            "",
            "mean skill",
            *(f"MAE {step} ({one.measure.unit})" for step in ahead),
            *(f"skill {step}" for step in ahead),
        ]
        tables += [table(one.question.where, heads, rows)] if rows else []
    note = Note("Skill is over persistence here.")
    return fold("By sensor and axis", *tables, note)


def _ablations(context: Context) -> list[Fold]:
    """Return what the plan and the timeline change: methods alike but for one of them."""
    steps = _steps(context)
    parts = list(dict.fromkeys(_known(one.question) for one in context.comparisons))
    tables = [*_actions(context, steps, parts), *_timelines(context, steps, parts)]
    note = Note(
        "Differences are paired: both are on the same recordings. An interval above 0 shows that the plan helps."
    )
    return fold("What the plan and the timeline change", *tables, note)


def _actions(context: Context, steps: Sequence[int], parts: Sequence[bool | None]) -> list[Table]:
    rows: list[Sequence[str | Cell]] = []
    for family in _families(context.methods, "actions"):
        planned = next((one for one in family if one.settings["actions"] == "planned"), None)
        for method in sorted(family, key=lambda one: by_method.ACTIONS.index(one.settings["actions"])):
            label = method.name if method is planned or planned is None else f"… {method.settings['actions']}"
            row: list[str | Cell] = [label]
            for known in parts:
                own = skill.sums(method, MODEL, steps, known)
                row.append(skill.cell(skill.skills(own), -1) if own else NONE)
                other = skill.sums(planned, MODEL, steps, known) if planned and planned is not method else {}
                lost = pairing.paired_intervals(other, own, skill.at_steps) if other and own else None
                row += [skill.cell(lost, -1), skill.cell(lost, -2)] if lost else [NONE, NONE]
            rows.append([*row, str(len(method.runs))])
    heads = [""]
    for known in parts:
        where = headline.PARTS[known] or "all recordings"
        heads += [f"{where}: mean skill", f"{where}: the plan's gain", f"{where}: the plan's gain at t+{steps[-1]}"]
    return [table("What the planned motion is worth", [*heads, "runs"], rows)] if rows else []


def _timelines(context: Context, steps: Sequence[int], parts: Sequence[bool | None]) -> list[Table]:
    rows: list[Sequence[str | Cell]] = []
    for family in _families(context.methods, "timeline"):
        for method in sorted(family, key=lambda one: str(one.settings["timeline"])):
            rate_hz = float(method.runs[0].details.config.get("rate_hz") or 0)
            row: list[str | Cell] = [
                f"{method.name} ({method.settings['timeline']})",
                f"{1000 / rate_hz:.0f}" if rate_hz else NONE,
            ]
            for known in parts:
                sums = skill.sums(method, MODEL, steps, known)
                row += [skill.cell(skill.skills(sums), -1), number(skill.mae(sums)[-1])] if sums else [NONE, NONE]
            rows.append([*row, str(len(method.runs))])
    heads, unit = ["", "a step (ms)"], units.common(run.details.config for run in context.runs)
    for known in parts:
        where = headline.PARTS[known] or "all recordings"
        heads += [f"{where}: mean skill", f"{where}: MAE t+{steps[-1]} ({unit})"]
    title = "Timelines: a step lasts differently, so rows cannot be compared"
    return [table(title, [*heads, "runs"], rows)] if rows else []


def _predictors(context: Context) -> list[str]:
    held = {name for run in context.runs for name in run.details.errors.predictors}
    return [name for name in single_run.EXPLAINED if name in held]


def _steps(context: Context) -> tuple[int, ...]:
    return reading.shown_steps([run.details for run in context.runs])


def _all_steps(context: Context) -> list[int]:
    return sorted(set.intersection(*(set(run.details.errors.steps) for run in context.runs)))


def _known(question: Question) -> bool | None:
    return next((known for known, name in headline.PARTS.items() if name and question.part.startswith(name)), None)


def _families(methods: Sequence[Method], what: str) -> list[list[Method]]:
    """Return the methods that differ in one setting alone, where there are several such."""
    found: dict[str, list[Method]] = {}
    for method in methods:
        found.setdefault(method.key_without(what), []).append(method)
    return [family for family in found.values() if len(family) > 1]
