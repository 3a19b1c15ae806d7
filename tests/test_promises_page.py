"""The page of evidence names the tests of each guarantee, and the pages on guarantees name every file of tests/promises."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
DOCS = TESTS.parent / "docs"
GUARANTEES = DOCS / "explanation" / "guarantees.md"
EVIDENCE = DOCS / "reference" / "evidence.md"
TEXT = "".join(page.read_text() for page in (EVIDENCE, DOCS / "explanation/limits.md", DOCS / "benchmarks/faults.md"))
NAMED = re.compile(r"`(?:tests/)?((?:\w+/)*test_[\w*]+\.py)`")


def rows() -> Iterator[list[str]]:
    """Yield the cells of each row of the table of evidence."""
    for line in EVIDENCE.read_text().split("\n## ")[0].splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("| ") and cells[0] not in ("guarantee", "---"):
            yield cells


@pytest.mark.parametrize("name", sorted(set(NAMED.findall(TEXT))))
def test_a_file_that_the_page_names_exists(name: str) -> None:
    assert list(TESTS.glob(name)), f"a page names {name}, which is not below tests/"


def test_every_file_of_tests_promises_is_named() -> None:
    named_files = {path for name in NAMED.findall(TEXT) for path in TESTS.glob(name)}
    assert sorted(set(TESTS.glob("promises/test_*.py")) - named_files) == []


def test_the_page_of_evidence_has_the_guarantees_in_their_order() -> None:
    guarantees = re.findall(r"^- \*\*(.+?)\.\*\* ", GUARANTEES.read_text().split("\n## Assumptions")[0], re.MULTILINE)
    assert len(guarantees) > 20
    assert guarantees == [cells[0] for cells in rows()]


def test_every_promise_names_a_test() -> None:
    assert [cells[0] for cells in rows() if len(cells) != 3 or not NAMED.search(cells[2])] == ["Bad input"]


def test_every_promise_states_how_it_is_kept() -> None:
    assert [cells[0] for cells in rows() if not cells[1]] == []
