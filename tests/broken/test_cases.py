"""Test that the inputs of the page on broken data are what the page says."""

from pathlib import Path

import pytest

from tests.broken.cases import CASES, Case, build
from tests.broken.table import PAGE, READERS


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.fault)
def test_an_input_is_built_and_has_a_row_on_the_page(case: Case, tmp_path: Path) -> None:
    build(case, tmp_path)
    assert any(path.is_file() for path in (tmp_path / "data").rglob("*"))
    assert f"\n| {case.fault} |" in PAGE.read_text()
    assert set(case.tools) <= set(READERS)


def test_polars_refuses_what_it_cannot_join_and_pandas_reads_copies_silently(tmp_path: Path) -> None:
    from tests.broken.table import REFUSED, SILENT, classify_tool

    for fault, tool, verdict in (("column is missing", "polars", REFUSED), ("copies", "pandas", SILENT)):
        (case,) = (case for case in CASES if fault in case.fault)
        build(case, tmp_path / tool)
        assert classify_tool(case, tool, tmp_path / tool) == verdict
