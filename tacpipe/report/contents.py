"""The files of a result, read."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

Tree = Mapping[str, Any]


def tree(result: Dataset, name: str) -> Tree:
    """Return what a JSON file of a result holds; empty where there is none of the name."""
    found: Tree = json.loads(result.files[name]) if name in result.files else {}
    return found


def history(result: Dataset) -> list[Tree]:
    """Return what ``history.jsonl`` states, one line an epoch; empty where nothing was trained by epochs."""
    lines = result.files["history.jsonl"].splitlines() if "history.jsonl" in result.files else []
    return [json.loads(line) for line in lines if line.strip()]
