"""A rerun of an ingest imports little: hashing the files needs nothing heavy."""

from collections.abc import Callable
from pathlib import Path

from tests.formats.slide_files import touched, write_roboskin
from tests.test_imports import HEAVY, imported


def test_a_hit_of_an_ingest_imports_nothing_heavy(tmp_path: Path, flat_trial: Callable[..., Path]) -> None:
    flat_trial(place=tmp_path / "published")
    words = "ingest xela-flat published -o data/recordings"
    assert "pyarrow" in imported(tmp_path, words)
    assert imported(tmp_path, words) & HEAVY == set()


def test_a_hit_of_many_slides_in_one_file_imports_nothing_heavy_either(tmp_path: Path) -> None:
    write_roboskin(tmp_path / "published", touched(2))
    words = "ingest roboskin published -o data/recordings"
    assert "pyarrow" in imported(tmp_path, words)
    assert imported(tmp_path, words) & HEAVY == set()
