"""Parts that tests of several formats share."""

import json
import tomllib
from pathlib import Path
from typing import Any

import pyarrow as pa

from tacpipe.formats import published
from tacpipe.formats.table.contained import Params
from tacpipe.plugins.stage import RecordingOutput


def layout_params(text: str) -> Params:
    """Return the params with the layout in a TOML text."""
    return Params(json.dumps(tomllib.loads(text)))


def read_single(read: Any, discover: Any, source: Path, params: published.Params | None = None) -> RecordingOutput:
    """Return the only recording below a folder, by the stage and the ``discover`` of a published format."""
    params = params or published.Params()
    (files,) = discover(params, source).values()
    recording = read(params, files)
    assert isinstance(recording, RecordingOutput)
    return recording


def about(table: pa.Table, column: str) -> dict[str, str]:
    """Return the metadata of a column as text."""
    return {key.decode(): value.decode() for key, value in (table.schema.field(column).metadata or {}).items()}


def edit(path: Path, old: str, new: str) -> None:
    """Replace the first occurrence of a text in a file."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
