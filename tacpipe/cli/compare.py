"""Compare evaluation results in one table per task and question, as text, JSON or CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypedDict

from tacpipe import printable
from tacpipe.comparison import engine
from tacpipe.comparison.engine import Comparison
from tacpipe.datasets.dataset import Dataset
from tacpipe.engine import pipeline
from tacpipe.errors import UsageError
from tacpipe.io import terminal
from tacpipe.io.terminal import RowGroup, TerminalRow, TerminalTable
from tacpipe.plugins.stage import Attribute
from tacpipe.scores import headline, words
from tacpipe.store.location import locate

METRICS = "metrics.json"
_LISTED = 3  # maximum number of values listed in a cell
_DIGITS = 9  # significant digits, as in stored headlines


class RowJson(TypedDict):
    """A method in a comparison; undefined numbers are None."""

    name: str
    kind: str
    settings: dict[str, Attribute]  # settings in which the methods differ
    errors: dict[str, float | None]
    baseline: str | None
    gain: float | None
    low: float | None
    high: float | None
    p: float | None
    n: int
    recordings: int
    runs: int
    seeds: int
    results: list[str]  # paths


class ComparisonJson(TypedDict):
    """The methods compared on one question."""

    task: str
    part: str
    target: str
    columns: list[str]
    unit: str
    ranked_by: str
    measure: str
    cluster: str
    rows: list[RowJson]


class ComparisonsJson(TypedDict):
    """All comparisons, in the format of ``tacpipe compare --json``."""

    schema_version: int
    comparisons: list[ComparisonJson]


@dataclass(frozen=True)
class Compared:
    """Results by requested path, with their comparisons."""

    results: Mapping[str, Dataset]
    comparisons: Sequence[Comparison]
    pooled: bool
    places: Mapping[str, str] = field(default_factory=dict)  # dataset paths by manifest digest

    def paths(self, row: engine.ComparisonRow) -> list[str]:
        """Return the paths of a row's results."""
        places = {id(result): path for path, result in self.results.items()}
        return [places[id(run.dataset)] for run in row.method.runs]

    def unused(self) -> list[str]:
        """Return the paths of results that contain nothing to compare."""
        used = {path for comparison in self.comparisons for row in comparison.rows for path in self.paths(row)}
        return [path for path in self.results if path not in used]

    def differing(self, rows: Iterable[engine.ComparisonRow]) -> dict[str, list[str]]:
        """Return the columns in which the rows differ, by name: settings, data and, without pooling, the result."""
        all_rows = list(rows)
        names = dict.fromkeys(name for row in all_rows for name in row.differing)
        columns = {name: [_text(row.differing.get(name, "")) for row in all_rows] for name in names}
        columns["data"] = [_join_values(self._data(run.dataset) for run in row.method.runs) for row in all_rows]
        if not self.pooled:
            columns["result"] = [_below(self.paths(row)[0], list(self.results)) for row in all_rows]
        return {name: cells for name, cells in columns.items() if len(set(cells)) > 1}

    def _data(self, result: Dataset) -> str:
        """Return the paths of a result's evaluation datasets; missing datasets are shown by the start of their digest."""
        datasets = result.source.inputs.get("datasets", ())
        return " ".join(self.places.get(dataset["manifest"], dataset["dataset"][:8]) for dataset in datasets)

    def to_json(self) -> ComparisonsJson:
        """Return all comparisons as plain values, with undefined numbers as null."""
        return {"schema_version": 1, "comparisons": [self._json(comparison) for comparison in self.comparisons]}

    def _json(self, comparison: Comparison) -> ComparisonJson:
        """Return the JSON value of one comparison, with all its rows."""
        return {
            "task": comparison.task,
            "part": comparison.question.part,
            "target": comparison.question.target,
            "columns": list(comparison.measure.columns),
            "unit": comparison.measure.unit,
            "ranked_by": comparison.measure.ranked_by,
            "measure": comparison.measure.name,
            "cluster": comparison.measure.cluster,
            "rows": [self._row(comparison, row) for row in comparison.rows],
        }

    def _row(self, comparison: Comparison, row: engine.ComparisonRow) -> RowJson:
        """Return the JSON value of a method or baseline; ``results`` are the paths of a method's results."""
        model = row.kind in ("model", "variant", "control") and row.predictor.startswith("model")
        return {
            "name": row.name,
            "kind": row.kind,
            "settings": dict(row.differing),
            "errors": dict(zip(comparison.measure.columns, map(_number, row.values), strict=True)),
            "baseline": row.baseline or None,
            "gain": _number(row.gain.mean),
            "low": _number(row.gain.low),
            "high": _number(row.gain.high),
            "p": _number(row.p),
            "n": row.n,
            "recordings": row.recordings,
            "runs": row.runs,
            "seeds": row.seeds,
            "results": self.paths(row) if model else [],
        }

    def to_csv(self) -> str:
        """Return a CSV with one line per predictor and question, and a column for each setting and error."""
        records = []
        for comparison in self.to_json()["comparisons"]:
            question = {name: comparison[name] for name in ("task", "part", "target", "measure")}
            for row in comparison["rows"]:
                values = {name: value for name, value in row.items() if name not in ("settings", "errors", "results")}
                records.append(
                    {**question, **values, **row["settings"], **row["errors"], "results": " ".join(row["results"])}
                )
        text = io.StringIO()
        heads = list(dict.fromkeys(name for record in records for name in record))
        writer = csv.DictWriter(text, heads, lineterminator="\n")
        writer.writeheader()
        writer.writerows(records)
        return text.getvalue().rstrip("\n")

    def tables(self) -> list[tuple[list[str], TerminalTable]]:
        """Return one table per task, kind of error and unit: methods with the best first, then their best baseline.

        Above each are the sentences of how the best method of each question compares with its best baseline.
        """
        by_columns: dict[tuple[str, ...], list[Comparison]] = {}
        for comparison in self.comparisons:
            measure = comparison.measure
            by_columns.setdefault((comparison.task, *measure.columns, measure.name, measure.unit), []).append(
                comparison
            )
        return [
            (words.summary([found for comparison in same if (found := comparison.headline)]), self._table(same))
            for same in by_columns.values()
        ]

    def _table(self, comparisons: Sequence[Comparison]) -> TerminalTable:
        """Return the table of comparisons with the same columns: methods, then the best baseline and the reference baseline.

        Columns are added for differing settings, and for baselines and runs where they vary.
        """
        measure = comparisons[0].measure
        rows_by_comparison = [[row for row in comparison.rows if _competes(row)] for comparison in comparisons]
        all_rows = [row for rows in rows_by_comparison for row in rows]
        differing, names = self.differing(all_rows), [_first_name(row) for row in all_rows]
        if len(set(names)) == 1 and "result" in differing:  # All rows have the same method, so paths distinguish them
            names = differing.pop("result")
        baselines = [row.baseline for row in all_rows]
        names_baselines = len({*baselines}) > len(comparisons)  # Methods of one question have different best baselines
        pooled = any(row.runs > 1 for row in all_rows)
        heads = ["", *differing, *words.heads(measure.columns, measure.name), "95 % interval"]
        heads += [*(["vs"] if names_baselines else []), "n", *(["runs"] if pooled else [])]
        groups, index = [], 0
        for comparison, rows in zip(comparisons, rows_by_comparison, strict=True):
            lines = []
            for row in rows:
                cells = [names[index], *(cells[index] for cells in differing.values())]
                cells += [*words.cells(measure.columns, row.values), *_gain(row, measure.name)]
                cells += [
                    *([row.baseline] if names_baselines else []),
                    f"{row.n:,}",
                    *([str(row.runs)] if pooled else []),
                ]
                lines.append(TerminalRow(cells, _style(row)))
                index += 1
            best = comparison.best_baseline
            if best is not None:
                empty = [""] * (len(heads) - 1 - len(differing) - len(measure.columns))
                cells = [
                    f"than {best.name}",
                    *[""] * len(differing),
                    *words.cells(measure.columns, best.values),
                    *empty,
                ]
                lines.append(TerminalRow(cells, "dim"))
                for reference in (
                    row for row in comparison.of("baseline") if row.name == measure.reference and row is not best
                ):
                    cells = [
                        reference.name,
                        *[""] * len(differing),
                        *words.cells(measure.columns, reference.values),
                        *empty,
                    ]
                    lines.append(TerminalRow(cells, "dim"))
            groups.append(
                RowGroup(comparison.question.where if len(comparisons) > 1 or comparison.question.where else "", lines)
            )
        first_error = 1 + len(differing)
        errors = list(range(first_error, first_error + len(measure.columns)))
        spare_columns = (
            [*errors[1:-2], *errors[-2:-1], *errors[:1]] if len(errors) > 2 else errors[:1] * (len(errors) > 1)
        )
        text_columns = [0, *range(1, first_error), *([heads.index("vs")] if names_baselines else [])]
        return TerminalTable(
            heads, groups, self._caption(comparisons), spare=list(dict.fromkeys(spare_columns)), left=text_columns
        )

    def _caption(self, comparisons: Sequence[Comparison]) -> str:
        """Return the caption of a table: units, what n counts, and the meaning of the measure and its intervals."""
        measure = comparisons[0].measure
        clusters = ", ".join(dict.fromkeys(comparison.measure.cluster for comparison in comparisons))
        fewest = min(row.n for comparison in comparisons for row in comparison.rows)
        few_note = (
            f" With n below {headline.MIN_CLUSTERS} no interval proves a difference."
            if fewest < headline.MIN_CLUSTERS
            else ""
        )
        chosen = max(len(comparison.models) for comparison in comparisons)
        chosen_from = f" The sentence accounts for the choice among {chosen} methods." if chosen > 1 else ""
        pooled = "Runs that differ only in seed or fold are pooled (--each lists them). " if self.pooled else ""
        return (
            f"n: {clusters}. Units: {measure.unit}. {words.explain_gain(measure.name, measure.ranked_by)} {pooled}"
            f"Intervals: jackknife over {clusters} and over seeds where there are several, method and baseline on the same "
            f"ones.{chosen_from}{few_note}"
        )


def run(paths: Sequence[Path], *, pool: bool) -> Compared:
    """Return the comparison of results, and warn about those that contain nothing to compare.

    ``pool`` joins runs that differ only in seed or fold. Raises `UsageError` for a dataset that is not a result, and if
    no result contains anything to compare.
    """
    results = {str(path): pipeline.open_dataset(path) for path in paths}
    for path, result in results.items():
        if METRICS not in result.files:
            raise UsageError(f"{path} was made by {result.source.stage}; give results of `tacpipe evaluate`.")
    compared = Compared(results, engine.compare(list(results.values()), pool=pool), pool, _paths_by_digest(paths))
    if not compared.comparisons:
        raise UsageError(
            "These results do not contain errors of single recordings. Run `tacpipe evaluate` again, or give "
            "results of recordings that the model has not seen."
        )
    reason = "there are no stored errors of single recordings that the model has not seen"
    for line in printable.grouped_failures(dict.fromkeys(compared.unused(), reason)):
        terminal.note(f"tacpipe: left out {line}.")
    return compared


def _competes(row: engine.ComparisonRow) -> bool:
    """Return whether a row is a trained method, i.e. a model or a trained control."""
    return row.kind == "model" or (row.kind == "control" and row.predictor == "model")


def _first_name(row: engine.ComparisonRow) -> str:
    name = row.method.runs[0].method
    return f"{name} (control)" if row.kind == "control" else name


def _gain(row: engine.ComparisonRow, measure: str) -> list[str]:
    """Return the gain over the best baseline and its interval as texts, "–" for those that are missing."""
    if not row.baseline:
        return [words.NONE, words.NONE]
    interval = words.format_interval(row.gain.low, row.gain.high, measure) or words.NONE
    return [words.format_gain(row.gain.mean, measure), interval]


def _style(row: engine.ComparisonRow) -> str:
    return {headline.BETTER: "green", headline.WORSE: "red"}.get(row.gain.verdict, "")


def _paths_by_digest(results: Sequence[Path]) -> dict[str, str]:
    """Return the paths of the store's datasets by manifest digest, relative to the working directory."""
    paths = {str(root["manifest"]): Path(root["path"]) for root in locate(*results).roots.all()}
    here = Path.cwd()
    return {name: str(path.relative_to(here) if path.is_relative_to(here) else path) for name, path in paths.items()}


def _below(path: str, paths: Sequence[str]) -> str:
    """Return a path without the parent folders that all paths have in common.

    >>> _below("results/a/0", ["results/a/0", "results/b/0"]), _below("results/a", ["results/a"])
    ('a/0', 'results/a')
    """
    folders = [Path(result_path).parent for result_path in paths]
    common = next(
        parent
        for parent in (folders[0], *folders[0].parents)
        if all(folder.is_relative_to(parent) for folder in folders)
    )
    return str(Path(path).relative_to(common)) if len(paths) > 1 else path


def _join_values(values: Iterable[str]) -> str:
    unique = sorted(set(values))
    return ", ".join(unique) if len(unique) <= _LISTED else f"{len(unique)} datasets"


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _number(value: float) -> float | None:
    return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None
