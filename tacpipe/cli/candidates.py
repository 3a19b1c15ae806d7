"""Add the command ``tacpipe candidates``, which prints possible grasps on an object and a model's prediction for each."""

from __future__ import annotations

import csv
import io
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import tacpipe
from tacpipe.datasets import replacing
from tacpipe.datasets.overview import describe_streams
from tacpipe.engine import pipeline
from tacpipe.errors import UsageError
from tacpipe.io import terminal
from tacpipe.io.files import readable_errors, write_whole
from tacpipe.plugins import registry

if TYPE_CHECKING:
    from tacpipe.clouds.candidates import Candidate
    from tacpipe.clouds.cloud import Cloud
    from tacpipe.clouds.grasp import Grasp

EXAMPLE = "\n\nExample: tacpipe candidates data/grasps --recording bleach-1561629162 --model models/touch"
HEADER = "rank,score,off_deg,"  # Start of the CSV file
PICTURES = (".pdf", ".png", ".svg")
Row = dict[str, float]


def add(program: typer.Typer, summary: str) -> None:
    """Add the command ``candidates`` to ``program``."""
    about = "\n\nPrints a table on a terminal, and CSV otherwise, with lengths in metres and touch in device counts."
    program.command("candidates", help=summary + about + EXAMPLE)(candidates)


def candidates(
    cloud: Annotated[
        Path, typer.Argument(help="File (.ply, .pcd …) with the object's points, or a dataset of grasps.")
    ],
    recording: Annotated[str | None, typer.Option("--recording", help="Name of the recording in a dataset.")] = None,
    model: Annotated[Path | None, typer.Option("--model", help="Model that predicts the touch of a grasp.")] = None,
    count: Annotated[int, typer.Option("--count", help="Maximum number of grasps, spread along the object.")] = 10,
    seed: Annotated[int, typer.Option("--seed", help="Random seed of the cuts through the object.")] = 0,
    shift: Annotated[
        float,
        typer.Option(
            "--shift", help="Maximum distance of cuts from the centroid, as a fraction of the object's length."
        ),
    ] = 0.4,
    opening_mm: Annotated[
        tuple[float, float], typer.Option("--opening-mm", help="Smallest and largest opening of the fingers, mm.")
    ] = (20, 130),
    camera_m: Annotated[
        tuple[float, float, float], typer.Option("--camera-m", help="Position of the camera in the cloud's frame, m.")
    ] = (0, 0, 0),
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Write CSV to this file.")] = None,
    picture: Annotated[
        Path | None, typer.Option("--picture", help="Draw the cloud and the grasps: .png, .svg.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Print possible grasps, best first."""
    _require_names(output, picture)
    predict = None if model is None else _predict_grasp(model)
    from tacpipe.clouds.candidates import candidates as find

    object_cloud = _cloud(cloud, recording)
    grasp_candidates = find(object_cloud, count, seed, shift, (opening_mm[0] / 1e3, opening_mm[1] / 1e3), camera_m)
    rows = [_row(rank, candidate) for rank, candidate in enumerate(grasp_candidates, 1)]
    if predict is not None:
        for row, candidate in zip(rows, grasp_candidates, strict=True):
            row |= predict(object_cloud, candidate.grasp)
    if picture is not None:
        from tacpipe.clouds.candidates import draw

        draw(object_cloud, grasp_candidates, picture)
    if output is not None:
        _write(output, _csv(rows))
    if as_json:
        terminal.result_json({"schema_version": 1, "candidates": rows, "units": _units(rows)})
    elif output is not None:
        terminal.result(output)
    elif sys.stdout.isatty():
        _print_table(rows)
    else:
        terminal.result(_csv(rows).rstrip("\n"))


def _cloud(path: Path, recording: str | None) -> Cloud:
    """Return the cloud from a file, or from one recording of a dataset.

    Raises `UsageError` if the recording is missing, not unique, or has no cloud.
    """
    from tacpipe.clouds import files
    from tacpipe.clouds.cloud import Cloud

    if path.suffix.lower() in files.SUFFIXES or (path.is_file() and path.name != "manifest.json"):
        if recording is not None:
            raise UsageError(f"{path} is a single cloud; --recording {recording} selects from a dataset. Leave it out.")
        return files.read(path)
    shards = pipeline.open_dataset(path).recordings
    if recording is None and len(shards) != 1:
        raise UsageError(
            f"{path} has {len(shards)} recordings. Choose one with --recording: {_name_excerpt(list(shards))}."
        )
    name = next(iter(shards)) if recording is None else recording
    if name not in shards:
        raise UsageError(f"{path} has no recording {name}; it has {_name_excerpt(list(shards))}.")
    if "cloud" not in shards[name].streams:
        raise UsageError(
            f"Recording {name} of {path} has no cloud; it {describe_streams(shards[name].streams)}. Give what "
            f"`tacpipe ingest` or `tacpipe segment grasps` made of grasps."
        )
    return Cloud.from_table(shards[name].table("cloud"))


def _name_excerpt(names: list[str]) -> str:
    first_names = ", ".join(names[:5])
    return (
        f"{first_names} … (`tacpipe show --full` lists all {len(names)})" if len(names) > 5 else first_names or "none"
    )


def _predict_grasp(path: Path) -> Callable[[Cloud, Grasp], Row]:
    """Return the grasp predictor of the model at ``path``. Raises `UsageError` if its task has none."""
    from tacpipe.tasks.task import task_of_model

    task = task_of_model(tacpipe.open(path).files, str(path))
    predict = task.grasp_predictor
    if predict is None:
        able = [name for name in registry.tasks() if registry.load_task(name).grasp_predictor is not None]
        raise UsageError(
            f"{path} is a model of task {task.name}, which predicts recordings and not single grasps. Give a model of task "
            f"{' or '.join(able)}: {' or '.join(f'`tacpipe train {name}`' for name in able)} makes one."
        )
    return partial(predict, tacpipe.load(path))


def _row(rank: int, candidate: Candidate) -> Row:
    """Return the values of a candidate and its rank by column; column names end with the unit."""
    from tacpipe.clouds.grasp import POINTS, WRIST

    grasp = candidate.grasp
    values: Row = {
        "rank": rank,
        "score": round(candidate.score, 4),
        "off_deg": round(candidate.off_deg, 2),
        "shift_m": round(candidate.shift_m, 6),
        "opening_m": round(grasp.opening_m, 6),
    }
    points = (*grasp.g1_m, *grasp.g2_m)
    values |= {name: round(float(value), 6) for name, value in zip(POINTS, points, strict=True)}
    if grasp.wrist is not None:
        values |= {name: round(float(value), 6) for name, value in zip(WRIST, grasp.wrist.T.ravel(), strict=True)}
    return values


def _units(rows: list[Row]) -> dict[str, str]:
    ends = {"m": "m", "deg": "degree", "counts": "count"}
    return {name: ends.get(name.rpartition("_")[2], "1") for name in rows[0]}


def _csv(rows: list[Row]) -> str:
    """Return rows as CSV with a header."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _require_names(output: Path | None, picture: Path | None) -> None:
    """Raise `UsageError` before any computation if an output has a wrong suffix or is a file of another program."""
    if output is not None:
        if output.suffix.lower() != ".csv":
            raise UsageError(f"{output} must end in .csv, because the command writes CSV. --json prints JSON instead.")
        replacing.refuse_foreign(output, HEADER.encode())
    if picture is not None and picture.suffix.lower() not in PICTURES:
        raise UsageError(f"{picture} is not a name for a picture; it must end in one of {', '.join(PICTURES)}.")


def _write(path: Path, text: str) -> None:
    with readable_errors(path.parent):
        write_whole(str(path), text.encode(), f"{path}.draft")


def _print_table(rows: list[Row]) -> None:
    """Print a compact table: points in millimetres, and each finger's pressure and mean electrode value."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    columns = ["#", "score", "open mm", "off °", "g1 mm", "g2 mm", "approach"]
    has_prediction = "pdc_th_counts" in rows[0]
    columns += ["PDC th", "PDC mf", "mean E th", "mean E mf"] if has_prediction else []
    table = Table(box=box.SIMPLE, pad_edge=False, padding=(0, 1))
    for name in columns:
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        cells = [f"{row['rank']}", f"{row['score']:.2f}", f"{row['opening_m'] * 1e3:.0f}", f"{row['off_deg']:.0f}"]
        cells += [" ".join(f"{row[f'{point}_{axis}_m'] * 1e3:.0f}" for axis in "xyz") for point in ("g1", "g2")]
        cells.append(" ".join(f"{row[f'wrist_x_{axis}']:.2f}" for axis in "xyz"))
        if has_prediction:
            cells += [f"{row[f'pdc_{finger}_counts']:.0f}" for finger in ("th", "mf")]
            cells += [f"{sum(_electrodes(row, finger)) / 24:.0f}" for finger in ("th", "mf")]
        table.add_row(*cells)
    Console().print(table)


def _electrodes(row: Row, finger: str) -> list[float]:
    return [value for name, value in row.items() if name.startswith(f"e_{finger}_")]
