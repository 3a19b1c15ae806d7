"""Add the command ``tacpipe limits``, which estimates the limits of touch prediction and the benefit of more grasps."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tacpipe.datasets import replacing
from tacpipe.errors import UsageError
from tacpipe.io import terminal
from tacpipe.io.files import readable_errors, write_whole

if TYPE_CHECKING:
    from tacpipe.metrics.intervals import Estimate
    from tacpipe.tasks.touch.limits import Limits

ABOUT = (
    "\n\nPairs of grasps: the similarity of the readings of two grasps of one object, by the distance of the grasps, and "
    "the skill of a predictor with the same error. Near pairs also differ in pose, so this skill is a lower bound. "
    "Learning curve: the skill on known objects, by the number of training grasps per object. Other finger: the skill if "
    "the model also reads the other finger. Skill is 1 - RMSE / RMSE of the constant. The command takes minutes."
)
EXAMPLE = "\n\nExample: tacpipe limits data/grasps -o results/limits.json"
HEADER = '{"schema_version": 1, "limits"'  # start of the file
TARGETS = ("pdc_th", "pdc_mf", "e_th", "e_mf")


def add(program: typer.Typer, summary: str) -> None:
    """Add the command ``limits`` to ``program``."""
    program.command("limits", help=summary + ABOUT + EXAMPLE)(limits)


def limits(
    grasps: Annotated[Path, typer.Argument(help="Dataset of grasps with readings.")],
    sizes: Annotated[
        str, typer.Option("--sizes", help="Training grasps per object, a comma-separated list.")
    ] = "2,4,8,16,32",
    draws: Annotated[int, typer.Option("--draws", min=1, help="Number of draws of folds and training grasps.")] = 2,
    trees: Annotated[int, typer.Option("--trees", min=1, help="Number of trees per forest.")] = 100,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Random seed of the draws and the trees.")] = 0,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Also write JSON to this file.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Print what limits the prediction of touch on grasps."""
    training_sizes = _parse_sizes(sizes)
    if output is not None:
        replacing.refuse_foreign(output, HEADER.encode())
    from tacpipe.engine import pipeline
    from tacpipe.tasks.touch import grasps as touch_grasps
    from tacpipe.tasks.touch import limits as touch_limits

    dataset = pipeline.open_dataset(grasps)
    with terminal.progress_bar("limits", touch_limits.steps(training_sizes, draws)) as advance:
        measured = touch_limits.limits(
            touch_grasps.read(dataset), sizes=training_sizes, draws=draws, trees=trees, seed=seed, advance=advance
        )
    value = {"schema_version": 1, "limits": measured.to_json()}
    if output is not None:
        _write(output, json.dumps(value) + "\n")
    terminal.result_json(value) if as_json else terminal.result(format_limits(measured))


def format_limits(measured: Limits) -> str:
    """Return the limits as three tables of text."""
    grasps = sum(measured.counts.values())
    lines = [f"{grasps} grasps of {len(measured.counts)} objects"]
    for title, measure in (
        ("skill of a predictor whose error equals their difference", "pair_skill"),
        ("similarity of the readings of one object", "likeness"),
    ):
        rows = []
        for low, high, by_target in measured.near:
            pairs = max(estimates.pairs for estimates in by_target.values())
            cells = [_cell(getattr(by_target[name], measure)) for name in TARGETS]
            rows.append([_bounds(low, high), str(pairs), *cells])
        lines += ["", f"pairs of grasps: {title}", *_table(["distance (mm)", "pairs", *TARGETS], rows)]
    lines += ["", "learning curve: skill on known objects"]
    rows = [
        [str(point.grasps), f"{point.trained:.0f}", *(_cell(point.skill[name]) for name in TARGETS)]
        for point in measured.curve
    ]
    rows.append(["with other finger", "", *(_cell(measured.other_finger[name]) for name in TARGETS)])
    lines += _table(["grasps per object", "trained on", *TARGETS], rows)
    lines += [
        "",
        "Pairs also differ in pose, so the skill of near pairs is a lower bound on the skill that a model can reach.",
        "Skill: 1 - RMSE / RMSE of the constant. Similarity: 1 for equal readings, 0 for the mean difference of two grasps",
        f"of the object. Brackets: 95 % interval over grasps. {measured.draws} draws of 5 folds.",
    ]
    return "\n".join(lines)


def _write(path: Path, content: str) -> None:
    with readable_errors(path.parent):
        write_whole(str(path), content.encode(), f"{path}.draft")


def _parse_sizes(option_text: str) -> list[int]:
    """Return the sizes of a comma-separated list, sorted. Raises `UsageError` unless they are whole numbers from 1."""
    try:
        sizes = [int(size) for size in option_text.split(",")]
    except ValueError:
        sizes = []
    if not sizes or min(sizes) < 1:
        raise UsageError(f"--sizes is {option_text!r}; it must be whole numbers from 1, with commas between, as 2,4,8.")
    return sorted(set(sizes))


def _bounds(low: float, high: float) -> str:
    return f"{low:g} or more" if math.isinf(high) else f"{low:g} to {high:g}"


def _cell(estimate: Estimate) -> str:
    if math.isnan(estimate.mean):
        return "-"
    bounds = "" if math.isnan(estimate.low) else f" ({_format_fixed(estimate.low)} to {_format_fixed(estimate.high)})"
    return _format_fixed(estimate.mean) + bounds


def _format_fixed(value: float) -> str:
    return f"{value:.2f}"


def _table(heads: Sequence[str], rows: Sequence[Sequence[Any]]) -> list[str]:
    """Return the lines of a table of text with aligned columns."""
    widths = [max(len(str(row[column])) for row in [heads, *rows]) for column in range(len(heads))]
    return [
        "  ".join(str(cell).ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in [heads, *rows]
    ]
