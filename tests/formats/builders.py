"""Parts that tests of several formats share."""

import json
import tomllib
from pathlib import Path

import pyarrow as pa

from tacpipe.formats.table.contained import Params


def layout_params(text: str) -> Params:
    """Return the params with the layout in a TOML text."""
    return Params(json.dumps(tomllib.loads(text)))


def about(table: pa.Table, column: str) -> dict[str, str]:
    """Return the metadata of a column as text."""
    return {key.decode(): value.decode() for key, value in (table.schema.field(column).metadata or {}).items()}


def edit(path: Path, old: str, new: str) -> None:
    """Replace the first occurrence of a text in a file."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
