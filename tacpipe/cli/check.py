"""Examine recordings for faults that a result would not show: ``tacpipe check``."""

from __future__ import annotations

import os
import tempfile
import tomllib
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import tacpipe
from tacpipe.errors import FAILED, UsageError
from tacpipe.formats import container
from tacpipe.io import terminal

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

MANIFEST, STORE = "manifest.json", "TACPIPE_STORE"
ABOUT = (
    "\n\nExamines stamps, offsets, lags, channels, columns, labels, copies and cuts. Changes nothing, except that --accept "
    "writes DATASET.accepted.json. Exits with 1 if a finding is not accepted."
    "\n\nExample: tacpipe check data/recordings"
)


def add(program: typer.Typer, summary: str) -> None:
    """Add the command ``check`` to ``program``."""
    program.command("check", help=summary + ABOUT)(check)


def check(
    dataset: Annotated[Path, typer.Argument(help="Recordings, or a folder of files that tacpipe ingest reads.")],
    layout: Annotated[Path | None, typer.Option("--layout", help="Layout file of the files in a folder.")] = None,
    accept: Annotated[
        list[str] | None, typer.Option("--accept", help="Identifier of a finding to accept; repeat for several.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Print the findings, and exit with 1 if any of them is not accepted."""
    from tacpipe.checks import examination

    with _recordings(dataset, layout) as recordings:
        if not len(recordings) and not recordings.source.skipped:
            raise UsageError(f"{dataset} was made by {recordings.source.stage} and has no recordings. Give recordings.")
        examined = examination.examine(recordings, dataset)
    if accept:
        examined.accept(accept)
    terminal.result_json(examined.to_json()) if as_json else terminal.result(examined.to_text())
    if examined.open_findings:
        raise typer.Exit(FAILED)


@contextmanager
def _recordings(path: Path, layout: Path | None) -> Iterator[Dataset]:
    """Yield the dataset at ``path``, or the recordings of its files from a temporary store.

    Raises `UsageError` for a layout of a dataset, and the errors of `tacpipe ingest`.
    """
    if path.is_file() or (path / MANIFEST).exists() or not path.exists():
        if layout is not None:
            raise UsageError(f"{path} is a dataset, which needs no layout; leave --layout out.")
        yield tacpipe.open(path)
        return
    store = os.environ.get(STORE)
    params: dict[str, Any] = {} if layout is None else {"layout": str(layout)}
    with tempfile.TemporaryDirectory(prefix="tacpipe-check-") as place:
        os.environ[STORE] = str(Path(place, "store"))
        try:
            with warnings.catch_warnings(record=True) as notes:
                warnings.simplefilter("always", tacpipe.ResultWarning)
                name, output = f"ingest.{_format(path, layout)}", Path(place, "recordings")
                recordings = tacpipe.run(name, path, output=output, skip_bad=True, **params)
            for note in notes:
                terminal.note(f"tacpipe: {note.message}")
            yield recordings
        finally:
            del os.environ[STORE]
            if store is not None:
                os.environ[STORE] = store


def _format(folder: Path, layout: Path | None) -> str:
    """Return the format of files: ``table`` for a layout that names files, else the kind of the containers."""
    if layout is not None:
        try:
            streams = tomllib.loads(layout.read_text(encoding="utf-8")).get("streams", {})
        except (OSError, ValueError):  # the error of `tacpipe ingest` names the line
            return "table"
        if any("files" in stream for stream in streams.values() if isinstance(stream, dict)):
            return "table"
    return next((kind for kind in container.KINDS if container.find_containers(kind, folder)), "table")
