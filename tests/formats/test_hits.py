"""What a rerun of an ingest imports: hashing the files needs nothing heavy."""

from collections.abc import Callable
from pathlib import Path

from tests.test_imports import HEAVY, imported


def test_a_hit_of_an_ingest_imports_nothing_heavy(tmp_path: Path, flat_trial: Callable[..., Path]) -> None:
    flat_trial(place=tmp_path / "published")
    words = "ingest xela-flat published -o data/recordings"
    assert "pyarrow" in imported(tmp_path, words)
    assert imported(tmp_path, words) & HEAVY == set()
