"""Read and write safely: atomic files, digests, Parquet, YAML, the terminal, memory limits, signals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

Json = Mapping[str, Any]  # a JSON object of any content; a record whose fields have names has a type of its own
