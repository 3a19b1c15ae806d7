"""Read and write safely: atomic files, digests, Parquet, YAML, the terminal, memory limits, signals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

Scalar = str | int | float | bool  # value of a param or of a setting
Json = Mapping[str, Any]  # any JSON object; records with named fields have types of their own
JsonValue = str | int | float | bool | None | Sequence["JsonValue"] | Mapping[str, "JsonValue"]
JsonObject = Mapping[str, JsonValue]  # a JSON object whose values are checked before they are used
