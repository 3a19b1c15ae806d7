"""What the page states of forecasts beyond the comparison: by time ahead, channel, plan and timeline."""

from __future__ import annotations

import csv
import functools
import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.comparison.engine import Comparison, Row
from tacpipe.comparison.runs import MODEL, Method, Question, Run
from tacpipe.metrics import pairing
from tacpipe.metrics.forecast import Interval
from tacpipe.report import blocks, charts, learning
from tacpipe.report.blocks import NONE, Cell, Chart, Charts, Fold, Note, Table, fold, number, table
from tacpipe.report.charts import Line
from tacpipe.report.context import Context, median_run
from tacpipe.report.forward import bands, live, reading, representations, single_run, situations, traces
from tacpipe.report.forward import methods as by_method
from tacpipe.tasks.forward import headline, units
from tacpipe.tasks.forward.headline import BASELINE

if TYPE_CHECKING:
    from collections.abc import Callable

    from tacpipe.metrics.pairing import Sums

Tree = Mapping[str, Any]
LINES = 4  # methods in a figure of skill, the paper's not counted
FLOOR = -1.0  # skill at which figures end
TRACE_STEPS = (1, 5, 10)
LOSSES = {"training": "train_loss", "validation": "val_loss"}
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
        *_anticipation(context),
        *situations.folds(context),
        *live.folds(context),
        *representations.folds(context),
        *_predictions(context),
        *_training(context),
        *_single(context),
    ]


def columns(context: Context, comparison: Comparison) -> list[tuple[str, Callable[[Row], Cell]]]:
    """Return more columns of the table of all methods: skill by step, and errors with channels in other units."""
    steps, known = _steps(context), _known(comparison.question)
    unit = comparison.measure.unit

    @functools.cache
    def skills(row: Row, group: str) -> Interval | None:
        sums = _sums(row, steps, known, group)
        return _skills(sums) if sums else None

    def squared(group: str) -> Callable[[Row], Cell]:
        return lambda row: number(_mse(_sums(row, _all_steps(context), known, group)))

    def at(place: int) -> Callable[[Row], Cell]:
        return lambda row: _cell(skills(row, "both"), place)

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
        ("skill over persistence, channels standardised", lambda row: _cell(skills(row, "standard"), -1)),
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
        "Skill over persistence is 1 − squared error / squared error of persistence over all channels. Every representation "
        "is decoded to the channels' own unit before it is evaluated, so all rows can be compared. Errors without a step "
        "are means over all steps.",
        f"In the first run, {effective[0]}." if effective else "",
        both if any(len(one) > 1 for one in known.values()) else "",
        "The recorded motion represents the plan: errors of methods that read it hold for an arm that follows it perfectly."
        if any(run.actions == "planned" for run in runs)
        else "",
        "; ".join(f"{single_run.spelled(name)}: {single_run.EXPLAINED[name]}" for name in _predictors(context)) + ".",
    ]  # fmt: skip


def about_run(run: Run) -> dict[str, Cell | str]:
    """Return more columns of the table of runs."""
    epochs = len(run.details.history)
    return {"epochs": str(epochs) if epochs else NONE}


def paper(context: Context) -> Method | None:
    """Return the paper's method where the recordings are the paper's."""
    return by_method.papers(context.methods) if context.published else None


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
            found = _skills(_sums(row, steps, _known(one.question)))
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
    other = context.row(one, paper(context))
    found += [other] if other and other not in found else []
    return found + [row for row in one.of("baseline") if row.predictor != BASELINE][:1]


def _channels(context: Context) -> list[Fold]:
    """Return errors and skill by sensor and axis of the best method, of the paper's, and of persistence."""
    tables: list[Table] = []
    steps = _steps(context)
    for one in context.comparisons:
        chosen = [row for row in dict.fromkeys([one.best, context.row(one, paper(context))]) if row]
        if not chosen:
            continue
        known = _known(one.question)
        rows: list[Sequence[str | Cell]] = []
        groups = chosen[0].method.runs[0].details.errors.groups
        for group in (name for name in groups if name not in ("both", "standard", "feature", "latent")):
            for row in chosen:
                sums = _sums(row, steps, known, group)
                if sums:
                    found = _skills(sums)
                    cells = [
                        _cell(found, -1),
                        *map(number, _mae(sums)),
                        *(_cell(found, at) for at in range(len(steps))),
                    ]
                    rows.append([f"{group}, {row.name}", *cells])
            still = _of(chosen[0].method, BASELINE, steps, known, group)
            if still:
                rows.append([f"{group}, {BASELINE}", NONE, *map(number, _mae(still)), *[NONE] * len(steps)])
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
        "Differences are paired: each resample draws the same recordings. An interval above 0 shows that the plan helps."
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
                own = _of(method, MODEL, steps, known)
                row.append(_cell(_skills(own), -1) if own else NONE)
                other = _of(planned, MODEL, steps, known) if planned and planned is not method else {}
                lost = pairing.paired_intervals(other, own, _skill_of(len(steps))) if other and own else None
                row += [_cell(lost, -1), _cell(lost, -2)] if lost else [NONE, NONE]
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
                sums = _of(method, MODEL, steps, known)
                row += [_cell(_skills(sums), -1), number(_mae(sums)[-1])] if sums else [NONE, NONE]
            rows.append([*row, str(len(method.runs))])
    heads, unit = ["", "a step (ms)"], units.common(run.details.config for run in context.runs)
    for known in parts:
        where = headline.PARTS[known] or "all recordings"
        heads += [f"{where}: mean skill", f"{where}: MAE t+{steps[-1]} ({unit})"]
    title = "Timelines: a step lasts differently, so rows cannot be compared"
    return [table(title, [*heads, "runs"], rows)] if rows else []


def _anticipation(context: Context) -> list[Fold]:
    """Return how often and how early a method sees a change come; nothing where no result states it."""
    source = max(context.methods, key=lambda one: len(one.runs))
    described = [(one.name, anticipation(one, MODEL)) for one in context.methods]
    names = {name for run in source.runs for name in run.details.metrics.get("anticipation", {})} - {MODEL}
    described += [(single_run.spelled(name), anticipation(source, name)) for name in sorted(names)]
    measures = ("median_lead_rows", "median_lead_frames", "false_alarms_per_minute")
    rows: list[Sequence[str | Cell]] = [
        [name, f"{found['events']:,.0f}", number(100 * found["recall"]), *(number(found[key]) for key in measures)]
        for name, found in sorted(described, key=lambda one: -one[1]["recall"] if one[1] else 0.0)
        if found
    ]
    heads = ["", "events", "seen coming (%)", "median lead (rows)", "median lead (frames)", "false alarms a minute"]
    return (
        fold("Anticipation", table("Changes that a forecast announces before they come", heads, rows)) if rows else []
    )


def anticipation(method: Method, predictor: str) -> dict[str, float] | None:
    """Return recall, leads and false alarms of a predictor, averaged over runs by their numbers of events."""
    described = [run.details.metrics.get("anticipation", {}).get(predictor) for run in method.runs]
    held = [one for one in described if one and one.get("events")]
    if not held:
        return None
    found: dict[str, float] = {"events": sum(float(one["events"]) for one in held)}
    for name in ("recall", "median_lead_rows", "median_lead_frames", "false_alarms_per_minute"):
        pairs = [(float(one[name]), float(one["events"])) for one in held if one.get(name) is not None]
        values, weights = zip(*pairs, strict=True) if pairs else ((float("nan"),), (1.0,))
        found[name] = float(np.average(values, weights=weights))
    return found


def _representatives(context: Context) -> list[tuple[Method, Run]]:
    """Return a median run of the best method of the last part, and of the paper's: those that are shown singly."""
    held = [one for one in context.comparisons if one.best]
    last = next((one for one in reversed(held) if one.question.place < 2), next(iter(held), None))  # the main timeline
    if last is None or last.best is None:
        return []
    chosen = [one for one in (last.best.method, paper(context)) if one]
    if len(context.runs) <= 2:
        chosen += list(context.methods)
    found = {
        one.name: (one, median_run(one, next(each for each in context.comparisons if one.of(each.question))))
        for one in chosen
    }
    return list(found.values())


def _predictions(context: Context) -> list[Fold]:
    """Return what was predicted next to what came, of recordings of median, lowest and highest skill, and the paper's."""
    drawn = []
    for method, run in _representatives(context):
        ranked = ranked_trials(run)
        places = {"median": len(ranked) // 2, "lowest": 0, "highest": len(ranked) - 1}
        named = {ranked[at][1]: (rank, ranked[at][0]) for rank, at in reversed(places.items()) if ranked}
        for name, (rank, skill) in list(reversed(named.items()))[: context.traces]:
            caption = f"The recording of {rank} skill ({blocks.signed(skill)}) of {method.name}."
            drawn += traces.draw(run.dataset.recordings[name], (0, 1), TRACE_STEPS, name, caption)
    return fold(
        "Predictions next to the truth", *drawn, *_paper_traces(context), Note(traces.UNSHIFTED) if drawn else None
    )


def _paper_traces(context: Context) -> list[Chart]:
    """Return Figures 5 and 6 of the paper: the first two components, and the second and fourth latent of AE-C1."""
    wanted = (
        ("PCA", (0, 1), "Figure 5 in the paper's form: the first two principal components"),
        ("AE-C1", (1, 3), "Figure 6 in the paper's form: the second and the fourth latent of AE-C1"),
    )
    drawn: list[Chart] = []
    for row, latents, title in wanted if context.published else ():
        found = [
            one
            for one in context.methods
            if by_method.recurrent(one) and by_method.paper_row(one.runs[0].details.config["codec"]) == row
        ]
        for method in found[:1]:
            held = next((one for one in context.comparisons if method.of(one.question)), None)
            run = median_run(method, held) if held else method.runs[0]
            ranked = ranked_trials(run)
            if ranked:
                name = ranked[len(ranked) // 2][1]
                caption = f"{name}, the recording of median skill of {method.name}."
                drawn += traces.draw(run.dataset.recordings[name], latents, (3, 5, 10), title, caption)
    return drawn


def ranked_trials(run: Run) -> list[tuple[float, str]]:
    """Return skill and name of the recordings that the model has not seen, of the predictions that a result holds."""
    text = run.dataset.files.get("trials.csv", b"").decode()
    return sorted(
        (float(one["skill"]), one["recording"])
        for one in csv.DictReader(io.StringIO(text))
        if one["seen"] == "false" and one["skill"] and one["recording"] in run.dataset.recordings
    )


def _training(context: Context) -> list[Fold]:
    """Return training and validation loss by epoch of the representative runs."""
    drawn = []
    for method, run in _representatives(context):
        history = run.details.history
        if not history:
            continue
        best = min(history, key=lambda line: line["val_loss"])
        curves = {name: [[one[key] for one in history]] for name, key in LOSSES.items()}
        spec = {**learning.by_epoch(curves, "loss (scaled latents)", log=True), "height": 190}
        kept = (
            f"{len(history)} epochs; the weights of epoch {best['epoch']} were kept, whose validation loss is lowest."
        )
        drawn.append(Chart(f"Loss by epoch: {method.name}", spec, kept))
    return fold("Training", Charts(drawn)) if drawn else []


def _single(context: Context) -> list[Fold]:
    """Return the errors of representative runs in full, by predictor and step."""
    return [one for method, run in _representatives(context) for one in single_run.folds(method.name, run)]


def _predictors(context: Context) -> list[str]:
    held = {name for run in context.runs for name in run.details.errors.predictors}
    return [name for name in single_run.EXPLAINED if name in held]


def _steps(context: Context) -> tuple[int, ...]:
    return reading.shown_steps([run.details for run in context.runs])


def _all_steps(context: Context) -> list[int]:
    return sorted(set.intersection(*(set(run.details.errors.steps) for run in context.runs)))


def _known(question: Question) -> bool | None:
    return next((known for known, name in headline.PARTS.items() if name and question.part.startswith(name)), None)


def _sums(row: Row, steps: Sequence[int], known: bool | None, group: str = "both") -> Sums:
    """Return the sums of a row's predictor at some steps in a group of channels, by seed and recording."""
    return _of(row.method, row.predictor.split(" ")[0], steps, known, group)


def _of(method: Method, predictor: str, steps: Sequence[int], known: bool | None, group: str = "both") -> Sums:
    return pairing.added(
        ((run.seed, name), one)
        for run in method.runs
        for name, one in reading.sums(run.details, predictor, steps, known, group).items()
    )


def _skill_of(steps: int) -> Callable[[AnyFloats], AnyFloats]:
    """Return what gives the skill over persistence at each step and its mean, from sums (draw, part)."""

    def skill(found: AnyFloats) -> AnyFloats:
        squared, still = found[:, :steps], found[:, steps : 2 * steps]
        one = np.where(still > 0, 1 - squared / np.where(still > 0, still, 1), np.nan)
        return np.hstack([one, one.mean(axis=1, keepdims=True)])

    return skill


def _skills(sums: Sums) -> Interval:
    width = len(next(iter(sums.values())))
    return pairing.intervals(sums, _skill_of((width - 1) // 3))


def _total(sums: Sums) -> AnyFloats:
    found: AnyFloats = np.sum(list(sums.values()), axis=0)
    return found


def _mae(sums: Sums) -> list[float]:
    total = _total(sums)
    steps = (len(total) - 1) // 3
    return [float(value) for value in total[2 * steps : 3 * steps] / total[-1]]


def _mse(sums: Sums) -> float:
    if not sums:
        return float("nan")
    total = _total(sums)
    return float((total[: (len(total) - 1) // 3] / total[-1]).mean())


def _cell(found: Interval | None, at: int) -> Cell:
    if found is None:
        return Cell(NONE)
    return blocks.interval(float(found.mean[at]), float(found.low[at]), float(found.high[at]))


def _families(methods: Sequence[Method], what: str) -> list[list[Method]]:
    """Return the methods that differ in one setting alone, where there are several such."""
    found: dict[str, list[Method]] = {}
    for method in methods:
        found.setdefault(method.key_without(what), []).append(method)
    return [family for family in found.values() if len(family) > 1]
