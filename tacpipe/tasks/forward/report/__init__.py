"""Report results of forecasts."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.comparison.engine import Comparison, ComparisonRow
from tacpipe.comparison.runs import MODEL, Kind, Question, TaskReport
from tacpipe.metrics import pairing
from tacpipe.metrics.intervals import Interval
from tacpipe.report import blocks, charts
from tacpipe.report.blocks import NONE, Cell, Chart, Charts, Fold, SmallPrint, Table, fold, number, table
from tacpipe.report.charts import Curve
from tacpipe.report.context import Context
from tacpipe.tasks.forward import headline
from tacpipe.tasks.forward.headline import BASELINE
from tacpipe.tasks.forward.report import events, figures, methods, representations, skill
from tacpipe.tasks.forward.report.methods import ACTIONS, ComparedRun, Method, shown_steps

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset


class ForwardReport(TaskReport):
    """The report of the task ``forward``."""

    title = "forecasts of tactile signals"

    def read(self, results: Sequence[Dataset]) -> list[ComparedRun]:
        """Return the runs of results with error sums of recordings that the model was not trained on."""
        return methods.read_runs(results)

    def kind(self, predictor: str) -> Kind:
        """Return the kind of a predictor.

        >>> report = ForwardReport("forward")
        >>> [report.kind(name) for name in ("model", "model_anchored", "ridge", "codec", "codec_persistence PCA-20")]
        ['model', 'variant', 'baseline', 'oracle', 'control']
        """
        if predictor.startswith("model"):
            return "model" if predictor == "model" else "variant"
        if predictor.split(" ")[0] in methods.ORACLES:
            return "oracle"
        return "control" if predictor.startswith("codec") else "baseline"

    def predictor_name(self, predictor: str) -> str:
        """Return the name of a predictor in tables.

        >>> report = ForwardReport("forward")
        >>> report.predictor_name("model_anchored"), report.predictor_name("codec_persistence PCA-20")
        ('anchored', 'codec persistence PCA-20')
        """
        return super().predictor_name(predictor.removeprefix("model_"))

    def uses(self, dataset: Dataset) -> bool:
        """Return whether a dataset is a codec of ``tacpipe compress``, whose losses are drawn with the forecast errors."""
        return representations.CODEC_FILE in dataset.files

    def columns(
        self, context: Context, comparison: Comparison
    ) -> Sequence[tuple[str, Callable[[ComparisonRow], Cell]]]:
        """Return further columns for the table of all methods: skill by step, errors in several units, and windows.

        A column is its heading and a function that returns the cell of a row.
        """
        steps, known_objects = _steps(context), _known_objects(comparison.question)
        unit = comparison.measure.unit

        @functools.cache
        def skills(row: ComparisonRow, group: str) -> Interval | None:
            sums = skill.sums_of_row(row, steps, known_objects, group)
            return skill.skill_intervals(sums) if sums else None

        def squared_error_column(group: str) -> Callable[[ComparisonRow], Cell]:
            return lambda row: number(
                skill.mean_squared(skill.sums_of_row(row, _all_steps(context), known_objects, group))
            )

        def skill_column(index: int) -> Callable[[ComparisonRow], Cell]:
            return lambda row: skill.skill_cell(skills(row, "both"), index)

        def windows(row: ComparisonRow) -> Cell:
            counts: dict[str, int] = {}
            for run in row.method.of(comparison.question):
                errors = run.details.errors
                for name, count, is_known in zip(errors.recordings, errors.windows, errors.known, strict=True):
                    if known_objects is None or bool(is_known) == known_objects:
                        counts[name] = max(int(count), counts.get(name, 0))
            return Cell(f"{sum(counts.values()):,}", value=sum(counts.values()))

        return [
            *((f"skill over persistence t+{step}", skill_column(index)) for index, step in enumerate(steps)),
            (
                "skill over persistence, channels standardised",
                lambda row: skill.skill_cell(skills(row, "standard"), -1),
            ),
            (f"MSE ({unit}²)", squared_error_column("both")),
            ("MSE (standardised)", squared_error_column("standard")),
            ("windows", windows),
        ]

    def folds(self, context: Context) -> list[Fold]:
        """Return the sections that only forecasts have."""
        if not context.comparisons:
            return representations.representation_folds(context)
        return [
            *_skill_ahead_charts(context),
            *_channels(context),
            *_ablations(context),
            *skill.band_folds(context),
            *skill.situation_folds(context),
            *events.live_folds(context),
            *representations.representation_folds(context),
            *figures.prediction_folds(context),
            *figures.training_folds(context),
            *figures.single_run_folds(context),
        ]

    def caveats(self, context: Context) -> list[str]:
        """Return the limitations of these results; empty strings for those that do not apply."""
        runs = [run.details for run in context.runs]
        known_by_recording: dict[str, set[bool]] = {}
        values: dict[str, set[Any]] = {}
        for run in runs:
            for name, is_known in zip(run.errors.recordings, run.errors.known, strict=True):
                known_by_recording.setdefault(name, set()).add(bool(is_known))
            for name in SETTINGS:
                if run.config["params"].get(name) is not None:
                    values.setdefault(name, set()).add(run.config["params"][name])
        settings = "; ".join(
            f"{name} {', '.join(map(str, sorted(setting_values, key=str)))}" for name, setting_values in values.items()
        )
        counts = [run.metrics.fresh.counts for run in runs[:1]]
        mixed = "For some recordings, the object is known to one run and unseen by another."
        effective = [
            f"{count['windows']:,} overlapping windows are equivalent to about {count['effective_windows']:,}"
            for count in counts
        ]
        return [
            f"Settings: {settings}." if settings else "",
            *_look_ahead_notes(context),
            "Skill over persistence is 1 − mean absolute error / mean absolute error of persistence over all channels, as "
            "the geometric mean of the ratios over recordings. All predictions are decoded to the unit of the channels "
            "before the evaluation, so all rows can be compared. Errors without a step are means over all steps.",
            f"In the first run, {effective[0]}." if effective else "",
            mixed if any(len(values_of_recording) > 1 for values_of_recording in known_by_recording.values()) else "",
            "The plan is the recorded motion, so errors of methods that read it are valid for an arm that follows its plan "
            "perfectly."
            if any(run.actions == "planned" for run in runs)
            else "",
            "; ".join(f"{figures.predictor_title(name)}: {figures.EXPLAINED[name]}" for name in _predictors(context)) + ".",
        ]  # fmt: skip

    def run_columns(self, run: ComparedRun) -> dict[str, str | Cell]:
        """Return further columns for the table of runs."""
        epochs = len(run.details.history)
        return {"epochs": str(epochs) if epochs else NONE}


LINES = 4  # maximum number of methods in a figure of skill, in addition to the paper's
FLOOR = -1.0  # minimum skill in figures
SETTINGS = ("preset", "epochs", "stride", "hidden", "batch", "seed")


def _look_ahead_notes(context: Context) -> list[str]:
    """Return how far the training rows of models look ahead, with the methods' names if they differ."""
    methods: dict[str, list[str]] = {}
    for method in context.methods:
        notes = [headline.look_ahead_notes(run.details.config) for run in method.runs]
        for note in dict.fromkeys(itertools.chain.from_iterable(notes)):
            methods.setdefault(note, []).append(method.name)
    return [
        note if len(names) == len(context.methods) else f"{blocks.listed(names)}: {note}"
        for note, names in methods.items()
    ]


def _skill_ahead_charts(context: Context) -> list[Fold]:
    """Return charts of skill by time ahead for the best methods, the paper's and the best baseline, one per part."""
    drawn, order = [], list[str]()
    chosen = {comparison: _rows_to_show(context, comparison) for comparison in context.comparisons}
    for rows in chosen.values():
        order += [row.name for row in rows if row.name not in order]
    for comparison, rows in chosen.items():
        config = rows[0].method.runs[0].details.config
        rate_hz = float(config.get("rate_hz") or 0)
        steps = _all_steps(context)
        x = [1000 * step / rate_hz if rate_hz else float(step) for step in steps]
        lines, cut_off = [], []
        for row in rows:
            interval = skill.skill_intervals(skill.sums_of_row(row, steps, _known_objects(comparison.question)))
            mean, low, high = (getattr(interval, name)[:-1] for name in ("mean", "low", "high"))
            lines.append(Curve(row.name, x, mean, low, high, dashed=row.kind != "model"))
            cut_off += [row.name] if float(np.nanmin(mean)) < FLOOR else []
        caption = "Bands: 95 % intervals over recordings. Dashed: a baseline. Click a name to show only this method."
        caption += f" Ends at {blocks.signed(FLOOR, 1)}, above some of {blocks.listed(cut_off)}." if cut_off else ""
        spec = charts.lines(
            lines, f"time ahead ({'ms' if rate_hz else 'steps'})", "skill over persistence", order=order,
            level=("persistence", 0.0), floor=FLOOR,
        )  # fmt: skip
        drawn.append(Chart(f"Skill by time ahead: {comparison.question.where}", spec, caption))
    return fold("By time ahead", Charts(drawn)) if drawn else []


def _rows_to_show(context: Context, comparison: Comparison) -> list[ComparisonRow]:
    rows = comparison.models[:LINES]
    paper_row = context.row(comparison, figures.paper_representative(context))
    rows += [paper_row] if paper_row and paper_row not in rows else []
    return rows + [row for row in comparison.of("baseline") if row.predictor != BASELINE][:1]


def _channels(context: Context) -> list[Fold]:
    """Return errors and skill by sensor and axis for the best method, the paper's, and persistence."""
    tables: list[Table] = []
    steps = _steps(context)
    for comparison in context.comparisons:
        chosen = [
            row
            for row in dict.fromkeys([comparison.best, context.row(comparison, figures.paper_representative(context))])
            if row
        ]
        if not chosen:
            continue
        known_objects = _known_objects(comparison.question)
        rows: list[Sequence[str | Cell]] = []
        groups = chosen[0].method.runs[0].details.errors.groups
        for group in (name for name in groups if name not in ("both", "standard", "feature", "latent")):
            for row in chosen:
                sums = skill.sums_of_row(row, steps, known_objects, group)
                if sums:
                    interval = skill.skill_intervals(sums)
                    cells = [
                        skill.skill_cell(interval, -1),
                        *map(number, skill.mean_absolute(sums)),
                        *(skill.skill_cell(interval, at) for at in range(len(steps))),
                    ]
                    rows.append([f"{group}, {row.name}", *cells])
            persistence = skill.sums_of_method(chosen[0].method, BASELINE, steps, known_objects, group)
            if persistence:
                rows.append(
                    [f"{group}, {BASELINE}", NONE, *map(number, skill.mean_absolute(persistence)), *[NONE] * len(steps)]
                )
        ahead = [f"t+{step}" for step in steps]
        heads = [
            "",
            "mean skill",
            *(f"MAE {step} ({comparison.measure.unit})" for step in ahead),
            *(f"skill {step}" for step in ahead),
        ]
        tables += [table(comparison.question.where, heads, rows)] if rows else []
    note = SmallPrint("Here, skill is relative to persistence.")
    return fold("By sensor and axis", *tables, note)


def _ablations(context: Context) -> list[Fold]:
    """Return the effect of the plan and of the timeline, by comparing methods that differ only in one of them."""
    steps = _steps(context)
    parts = list(dict.fromkeys(_known_objects(comparison.question) for comparison in context.comparisons))
    tables = [*_actions(context, steps, parts), *_timelines(context, steps, parts)]
    note = SmallPrint("Differences are paired by recording. An interval above 0 shows that the plan is useful.")
    return fold("Effects of the plan and the timeline", *tables, note)


def _actions(context: Context, steps: Sequence[int], parts: Sequence[bool | None]) -> list[Table]:
    """Return a table of skill with and without the plan of methods that differ only in ``actions``; empty without any."""
    rows: list[Sequence[str | Cell]] = []
    for family in _families(context.methods, "actions"):
        planned = next((candidate for candidate in family if candidate.settings["actions"] == "planned"), None)
        for method in sorted(family, key=lambda candidate: ACTIONS.index(candidate.settings["actions"])):
            label = method.name if method is planned or planned is None else f"… {method.settings['actions']}"
            row: list[str | Cell] = [label]
            for part in parts:
                method_sums = skill.sums_of_method(method, MODEL, steps, part)
                row.append(skill.skill_cell(skill.skill_intervals(method_sums), -1) if method_sums else NONE)
                planned_sums = (
                    skill.sums_of_method(planned, MODEL, steps, part) if planned and planned is not method else {}
                )
                lost = (
                    pairing.paired_intervals(planned_sums, method_sums, skill.at_steps)
                    if planned_sums and method_sums
                    else None
                )
                row += [skill.skill_cell(lost, -1), skill.skill_cell(lost, -2)] if lost else [NONE, NONE]
            rows.append([*row, str(len(method.runs))])
    heads = [""]
    for part in parts:
        place = headline.PARTS[part] or "all recordings"
        heads += [f"{place}: mean skill", f"{place}: the plan's gain", f"{place}: the plan's gain at t+{steps[-1]}"]
    return [table("Value of the planned motion", [*heads, "runs"], rows)] if rows else []


def _timelines(context: Context, steps: Sequence[int], parts: Sequence[bool | None]) -> list[Table]:
    """Return a table of methods that differ only in the timeline; empty without any."""
    rows: list[Sequence[str | Cell]] = []
    for family in _families(context.methods, "timeline"):
        for method in sorted(family, key=lambda candidate: str(candidate.settings["timeline"])):
            rate_hz = float(method.runs[0].details.config.get("rate_hz") or 0)
            row: list[str | Cell] = [
                f"{method.name} ({method.settings['timeline']})",
                f"{1000 / rate_hz:.0f}" if rate_hz else NONE,
            ]
            for part in parts:
                sums = skill.sums_of_method(method, MODEL, steps, part)
                row += (
                    [skill.skill_cell(skill.skill_intervals(sums), -1), number(skill.mean_absolute(sums)[-1])]
                    if sums
                    else [NONE, NONE]
                )
            rows.append([*row, str(len(method.runs))])
    heads, unit = ["", "a step (ms)"], headline.common_unit(run.details.config for run in context.runs)
    for part in parts:
        place = headline.PARTS[part] or "all recordings"
        heads += [f"{place}: mean skill", f"{place}: MAE t+{steps[-1]} ({unit})"]
    title = "Timelines: steps have different durations, so rows cannot be compared"
    return [table(title, [*heads, "runs"], rows)] if rows else []


def _predictors(context: Context) -> list[str]:
    predictors = {name for run in context.runs for name in run.details.errors.predictors}
    return [name for name in figures.EXPLAINED if name in predictors]


def _steps(context: Context) -> tuple[int, ...]:
    return shown_steps([run.details for run in context.runs])


def _all_steps(context: Context) -> list[int]:
    return sorted(set.intersection(*(set(run.details.errors.steps) for run in context.runs)))


def _known_objects(question: Question) -> bool | None:
    return next(
        (known_objects for known_objects, name in headline.PARTS.items() if name and question.part.startswith(name)),
        None,
    )


def _families(methods: Sequence[Method], setting: str) -> list[list[Method]]:
    """Return groups of several methods that differ only in one setting."""
    by_key: dict[str, list[Method]] = {}
    for method in methods:
        by_key.setdefault(method.key_without(setting), []).append(method)
    return [family for family in by_key.values() if len(family) > 1]
