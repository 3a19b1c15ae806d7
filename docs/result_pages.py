"""Compute the result pages of a release: `make result-pages DATA=FOLDER`.

The script runs the DVC pipeline of each task on the published recordings in ``DATA``, in ``.cache/result-pages``. It copies
the pages to ``dist/results`` and writes the tables of ``docs/results`` from the same results. An interrupted run can be
resumed: DVC skips finished stages, and tacpipe reuses stored results of an unfinished one.

``python docs/result_pages.py DATA --reduced [TASK...]`` tests the same commands in minutes, with one fold, one epoch and the
first method of each list. It writes pages to ``dist/reduced`` and does not change the tables.
"""

from __future__ import annotations

import csv
import io
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

if TYPE_CHECKING:
    from tacpipe.comparison.engine import Comparison, ComparisonRow

ROOT = Path(__file__).parents[1]
CONSTANT = "constant"  # predictor of touch
SETS = {  # task -> folders of its published set in DATA
    "forward": ("xela_flat_pick_move",),
    "material": ("biotac_slide_20_50", "roboskin_slide_20_50"),
    "touch": ("vision2tactile",),
}
HEADS = {  # task -> columns of its table: the group of a row, and the value
    "forward": ("objects", "skill"),
    "material": ("sensor", "accuracy_percent"),
    "touch": ("target", "skill"),
}
DIGITS = {"material": 1}  # decimal places; 3 for other tasks
ROWS = 7  # rows of a table


def table(comparisons: Sequence[Comparison]) -> str:
    """Return the main results of one task as CSV.

    The table of ``forward`` has all models and the best baselines. The tables of the other tasks have, for each sensor or
    each target, the best model, the paper's network and the best baseline, and one row for chance.
    """
    task = comparisons[0].task
    first = [comparison for comparison in comparisons if comparison.question.place == 0]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["method", *HEADS[task], "low", "high", first[0].measure.cluster])
    for comparison in first:
        part = comparison.question.target or comparison.question.part.removesuffix(" objects")
        entries = all_entries(comparison) if task == "forward" else main_entries(comparison)
        entries.sort(key=lambda entry: entry[1][0], reverse=True)
        for method, values, recordings in entries:
            writer.writerow([method, part, *(f"{value:.{DIGITS.get(task, 3)}f}" for value in values), recordings])
    count = max(comparison.rows[0].recordings for comparison in first)
    if task == "material":
        materials = len(first[0].rows[0].method.details[0].config["classes"])
        writer.writerow(["chance", "both", *[f"{100 / materials:.1f}"] * 3, count])
    if task == "touch":
        writer.writerow(["constant", "all", 0, 0, 0, count])
    return text.getvalue()


Entry = tuple[str, tuple[float, float, float], int]  # method; value, low and high; number of recordings


def all_entries(comparison: Comparison) -> list[Entry]:
    """Return all models, then baselines up to `ROWS` rows, the best ones first."""
    best = comparison.best_baseline
    entries = [entry(label(row), row, comparison) for row in comparison.models]
    baselines = comparison.of("baseline")[: max(ROWS - len(entries), 1)]
    return entries + [
        entry(f"{row.name} ({'best' if row is best else 'a'} baseline)", row, comparison) for row in baselines
    ]


def main_entries(comparison: Comparison) -> list[Entry]:
    """Return the best model, the best of the paper's networks, and the best baseline."""
    main_rows = {label(row): row for row in comparison.models[:1]}
    papers = [row for row in comparison.models if schedule(row)[1]]
    main_rows |= {label(row): row for row in papers[:1]}
    best = comparison.best_baseline
    if best and best.predictor != CONSTANT:  # The constant has its own row
        main_rows[f"{best.name} (best baseline)"] = best
    return [entry(name, row, comparison) for name, row in main_rows.items()]


def entry(name: str, row: ComparisonRow, comparison: Comparison) -> Entry:
    """Return a row of the table: skill over the constant for touch, otherwise the score of the task."""
    from tacpipe.comparison import engine

    value: Any = row.score
    if comparison.task == "touch":
        source = next((other.method for other in comparison.rows if other.predictor == CONSTANT), row.method)
        value = engine.difference(row.method, source, comparison.question, (row.predictor, CONSTANT))
    return name, (value.mean, value.low, value.high), row.recordings


def label(row: ComparisonRow) -> str:
    """Return a method's label: its name, "paper's network" if it is one, and its epochs if they are reduced."""
    shortened, paper = schedule(row)
    name = row.name.replace(f" ({shortened})", "").replace(f" · {shortened}", "") if shortened else row.name
    if paper:
        return f"{name} (paper's network{f', {shortened}' if shortened else ''})"
    return " · ".join(filter(None, [name, shortened]))


def schedule(row: ComparisonRow) -> tuple[str, bool]:
    """Return reduced epochs as "10 of 16 epochs", or an empty string, and whether the full schedule is a paper's."""
    from tacpipe.plugins import params as stage_params
    from tacpipe.plugins import registry

    result = row.method.details[0]
    kind = stage_params.kind_of(registry.load(result.STAGE), result.given)
    presets = stage_params.presets_of(kind)
    full = presets["paper"].get("epochs") if "paper" in presets else getattr(kind, "epochs", None)
    epochs = result.params.get("epochs")
    return f"{epochs:,} of {full:,} epochs" if epochs and full and epochs < full else "", "paper" in presets


def write_table(task: str, results: Path) -> Path:
    """Write the table of a task from the results in a folder, and return its path."""
    import tacpipe
    from tacpipe.comparison import engine

    opened = [tacpipe.open(path.parent) for path in sorted(results.rglob("metrics.json"))]
    path = ROOT / "docs" / "results" / f"{task}.csv"
    path.write_text(table(engine.compare(opened)), encoding="utf-8")
    return path


def published(params: dict[str, Any], data: Path) -> dict[str, Any]:
    """Return the params of all tasks for the published recordings in ``data``, following the comments of ``params.yaml``."""
    folder = {name: data / name for names in SETS.values() for name in names}
    forward, material, touch = (dict(params[task]) for task in SETS)
    forward["recordings"] = f"ingest xela-flat {folder['xela_flat_pick_move']} --replace"
    material = _by_authors(material)
    material["sources"] = {
        "biotac": f"ingest biotac-slide {folder['biotac_slide_20_50']} --replace",
        "roboskin": f"ingest roboskin {folder['roboskin_slide_20_50']} --replace",
    }
    touch = _estimated(touch)
    touch["recordings"] = f"ingest vision2tactile {folder['vision2tactile']} --replace"
    objects = [path for path in folder["vision2tactile"].iterdir() if path.is_dir()]
    touch["objects"] = list(range(len(objects)))
    return {**params, "forward": forward, "material": material, "touch": touch}


def reduced(block: Any) -> Any:
    """Return params with one epoch and only the first entry of each list of runs.

    >>> reduced({"folds": [0, 1], "methods": {"gru": {"epochs": 10}}, "split": {"folds": 5}})
    {'folds': [0], 'methods': {'gru': {'epochs': 1}}, 'split': {'folds': 5}}
    """
    if isinstance(block, list):
        return block[:1]
    if not isinstance(block, dict):
        return block
    return {name: 1 if name == "epochs" else reduced(value) for name, value in block.items()}


def _by_authors(block: Any) -> Any:
    """Return params with the authors' splits instead of k-fold splits."""
    if not isinstance(block, dict):
        return block
    if block.get("scheme") == "kfold":
        block = {name: value for name, value in block.items() if name != "folds"} | {"scheme": "authors"}
    return {name: _by_authors(value) for name, value in block.items()}


def _estimated(block: Any) -> Any:
    """Return params with an estimated instead of a recorded wrist."""
    if not isinstance(block, dict):
        return block
    return {
        name: "estimated" if name == "wrist" and value == "given" else _estimated(value)
        for name, value in block.items()
    }


def main(data: Path, tasks: list[str], *, use_reduced: bool = False) -> None:
    """Compute the pages of ``tasks``, with `reduced` params if requested. Raises `SystemExit` if a set is missing."""
    missing = [name for task in tasks for name in SETS[task] if not (data / name).is_dir()]
    if missing:
        raise SystemExit(
            f"{data} has no folder {', '.join(missing)}; data/README.md lists where the sets are published."
        )
    work = ROOT / ".cache" / ("reduced-pages" if use_reduced else "result-pages")
    out = ROOT / "dist" / ("reduced" if use_reduced else "results")
    (work / "docs" / "tasks").mkdir(parents=True, exist_ok=True)
    out.mkdir(parents=True, exist_ok=True)
    for name in ("dvc.yaml", "docs/tasks/horizons.json"):
        shutil.copy(ROOT / name, work / name)
    params = published(yaml.safe_load((ROOT / "params.yaml").read_text(encoding="utf-8")), data.resolve())
    if use_reduced:
        params = reduced(params)
    (work / "params.yaml").write_text(yaml.safe_dump(params, sort_keys=False), encoding="utf-8")
    programs = Path(sys.executable).parent
    dvc, environment = programs / "dvc", {**os.environ, "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}"}
    if not (work / ".dvc").exists():
        subprocess.run([dvc, "init", "--no-scm", "-q"], cwd=work, check=True)
    for task in tasks:
        subprocess.run([dvc, "repro", task], cwd=work, env=environment, check=True)
        shutil.copy(work / "results" / f"{task}.html", out)
        print(out / f"{task}.html")
        if not use_reduced:
            print(write_table(task, work / "results" / task))


if __name__ == "__main__":
    tasks = [argument for argument in sys.argv[2:] if argument != "--reduced"]
    main(Path(sys.argv[1]), tasks or list(SETS), use_reduced="--reduced" in sys.argv)
