"""Croissant 1.0: a JSON-LD description of the Parquet files, by which catalogues and loaders know their columns."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tacpipe.exports.contents import Column, Contents, shown

NAME = "croissant.json"
CONFORMS = "http://mlcommons.org/croissant/1.0"
_TYPES = {"bool": "sc:Boolean", "string": "sc:Text", "float": "sc:Float", "double": "sc:Float", "halffloat": "sc:Float"}
_OWN = (  # terms of Croissant's own vocabulary
    *("citeAs", "column", "equivalentProperty", "extract", "field", "fileProperty", "fileObject", "fileSet", "format"),
    *("includes", "isLiveDataset", "jsonPath", "key", "md5", "parentField", "path", "recordSet", "references", "regex"),
    *("repeated", "replace", "samplingRate", "separator", "source", "subField", "transform"),
)
CONTEXT: Mapping[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    **{term: f"cr:{term}" for term in _OWN},
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "sc": "https://schema.org/",
}


@dataclass(frozen=True)
class About:
    """What the publisher states of the data; empty where it is unknown."""

    name: str
    description: str
    license: str = ""
    creators: Sequence[str] = ()
    url: str = ""
    published: str = ""  # ISO 8601
    version: str = "1.0.0"
    cite_as: str = ""


def text(about: About, found: Contents, patterns: Mapping[str, str]) -> bytes:
    """Return ``croissant.json``; ``patterns`` are the paths of each stream's files."""
    value = {
        "@context": dict(CONTEXT),
        "@type": "sc:Dataset",
        "conformsTo": CONFORMS,
        "name": about.name,
        "description": about.description,
        "license": about.license,
        "creator": [{"@type": "sc:Organization", "name": name} for name in about.creators],
        "url": about.url,
        "datePublished": about.published,
        "version": about.version,
        "citeAs": about.cite_as,
        "distribution": [_files(shown(stream), patterns[stream]) for stream in found.streams],
        "recordSet": [_records(shown(one.name), one.columns) for one in found.streams.values()],
    }
    return json.dumps({key: one for key, one in value.items() if one}, indent=1, ensure_ascii=False).encode() + b"\n"


def _files(stream: str, pattern: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileSet",
        "@id": f"{stream}-files",
        "name": f"{stream}-files",
        "encodingFormat": "application/x-parquet",
        "includes": pattern,
    }


def _records(stream: str, columns: Sequence[Column]) -> dict[str, Any]:
    recording = Column("recording", "string", {"quantity": "name of the recording"})
    described_columns = [
        recording,
        *(column for column in columns if column.name != recording.name and type_of(column.type)),
    ]
    ids = identifiers([column.name for column in described_columns])
    return {
        "@type": "cr:RecordSet",
        "@id": stream,
        "name": stream,
        "description": f"Rows of the stream {stream}, of all recordings.",
        "field": [_field(stream, column, ids[column.name]) for column in described_columns],
    }


def identifiers(names: Sequence[str]) -> dict[str, str]:
    """Return an identifier for each column, without spaces and brackets, which readers refuse; no two alike.

    >>> identifiers(["taxel01_x", "Force X [N]", "Force X (N)"])
    {'taxel01_x': 'taxel01_x', 'Force X [N]': 'Force_X__N_', 'Force X (N)': 'Force_X__N__2'}
    """
    made: dict[str, str] = {}
    for name in names:
        letters = re.sub(r"[^A-Za-z0-9_.-]", "_", name)
        candidate, number = letters, 2
        while candidate in made.values():
            candidate, number = f"{letters}_{number}", number + 1
        made[name] = candidate
    return made


def _field(stream: str, column: Column, identifier: str) -> dict[str, Any]:
    return {
        "@type": "cr:Field",
        "@id": f"{stream}/{identifier}",
        "name": f"{stream}/{identifier}",
        "description": described(column),
        "dataType": type_of(column.type),
        "source": {"fileSet": {"@id": f"{stream}-files"}, "extract": {"column": column.name}},
    }


def described(column: Column) -> str:
    """Return what a column holds: quantity, unit, and whatever else its metadata state.

    >>> described(Column("taxel01_x", "uint16", {"quantity": "tactile", "unit": "count", "taxel": "1", "axis": "x"}))
    'tactile (count), axis x, taxel 1'
    """
    rest = [f"{key} {value}" for key, value in sorted(column.about.items()) if key not in ("quantity", "unit")]
    unit = f" ({column.unit})" if column.unit else ""
    return ", ".join([f"{column.quantity or column.name}{unit}", *rest])


def type_of(arrow_type: str) -> str:
    """Return the name of a type in Croissant; empty for one that it does not have."""
    return "sc:Integer" if arrow_type.lstrip("u").startswith("int") else _TYPES.get(arrow_type, "")
