"""docs/promises.md names the tests of each guarantee, and the pages on guarantees name every file of tests/promises."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
DOCS = TESTS.parent / "docs"
PAGE = DOCS / "promises.md"
TEXT = "".join((DOCS / name).read_text() for name in ("promises.md", "explanation/limits.md", "benchmarks/faults.md"))
NAMED = re.compile(r"`(?:tests/)?((?:\w+/)*test_[\w*]+\.py)`")


def rows() -> Iterator[list[str]]:
    """Yield the cells of each row of the table of promises."""
    table = PAGE.read_text().split("## Guarantees and evidence")[1].split("\n## ")[0]
    for line in table.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("| ") and cells[0] not in ("guarantee", "---"):
            yield cells


@pytest.mark.parametrize("name", sorted(set(NAMED.findall(TEXT))))
def test_a_file_that_the_page_names_exists(name: str) -> None:
    assert list(TESTS.glob(name)), f"a page names {name}, which is not below tests/"


def test_every_file_of_tests_promises_is_named() -> None:
    named_files = {path for name in NAMED.findall(TEXT) for path in TESTS.glob(name)}
    assert sorted(set(TESTS.glob("promises/test_*.py")) - named_files) == []


def test_every_promise_names_a_test() -> None:
    promises = list(rows())
    assert len(promises) > 20
    without = [cells[0] for cells in promises if len(cells) != 3 or not NAMED.search(cells[2])]
    assert without == ["Bad input gives one sentence and the documented exit code, and leaves everything as it was."]


def test_every_promise_states_how_it_is_kept() -> None:
    assert [cells[0] for cells in rows() if not cells[1]] == []
