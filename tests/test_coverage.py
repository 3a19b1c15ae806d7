"""How often intervals hold the truth in simulations, and the page that states it."""

import math
import os
from pathlib import Path
from typing import Any

import pytest

from tests.test_docs import module

PAGE = Path(__file__).parents[1] / "docs" / "benchmarks" / "intervals.md"
pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(
        "TACPIPE_TEST_COVERAGE" not in os.environ, reason="simulates for 10 minutes where TACPIPE_TEST_COVERAGE is set"
    ),
]


@pytest.fixture(scope="module")
def rows() -> list[list[str]]:
    """The cells of the tables that the command prints."""
    simulation: Any = module("intervals")
    return [line.strip("| ").split(" | ") for line in simulation.lines() if line and "---" not in line]


def tables_of_page() -> list[list[str]]:
    """Return the cells of the same tables on the page."""
    text = PAGE.read_text().split("python docs/intervals.py")[1].split("## Known limits")[0]
    return [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|") and "---" not in line]


def number(cell: str) -> float:
    try:
        return float(cell.removesuffix(" %"))
    except ValueError:
        return math.nan


def test_wherever_there_is_a_verdict_intervals_hold_the_truth_in_92_to_97_of_100_cases(rows: list[list[str]]) -> None:
    coverage = {tuple(row[:3]): number(row[4]) for row in rows if len(row) >= 6 and row[0] != "measure"}
    assert len(coverage) >= 30
    chance = 0.007  # standard deviation of a share of 1,000 repetitions
    stray = {
        case: share
        for case, share in coverage.items()
        if not (math.isnan(share) or abs(share - 0.945) < 0.025 + chance)
    }
    assert stray == {}


def test_the_best_of_equal_methods_is_called_better_about_as_rarely_as_a_single_one(rows: list[list[str]]) -> None:
    by_count = {row[0]: (number(row[2]), number(row[3])) for row in rows if len(row) == 4 and row[2].endswith("%")}
    assert by_count["12"][0] > 10 and max(chosen for _, chosen in by_count.values()) <= 4


def test_a_rate_over_slides_holds_for_the_same_materials_and_not_for_new_ones(rows: list[list[str]]) -> None:
    by_count = {row[0]: tuple(map(number, row[1:])) for row in rows if len(row) == 4 and row[1].startswith("0.")}
    assert set(by_count) == {"4", "10", "20", "40"}
    assert all(0.94 <= same <= 0.99 for same, _, _ in by_count.values())
    assert by_count["4"][1] < 0.8 and math.isnan(by_count["4"][2])
    assert by_count["40"][1] < 0.8 and 0.9 <= by_count["40"][2] <= 0.97


def test_intervals_of_areas_over_objects_hold_the_truth_in_91_to_98_of_100_cases(rows: list[list[str]]) -> None:
    by_case = {tuple(row[:2]): tuple(map(number, row[2:])) for row in rows if len(row) == 5 and row[0] != "objects"}
    assert len(by_case) == 16
    assert all(0.905 < share < 0.985 for _, *shares in by_case.values() for share in shares)
    assert min(percentile for percentile, *_ in by_case.values()) < 0.7


def test_the_page_holds_the_tables_that_the_command_prints(rows: list[list[str]]) -> None:
    for printed, stated_row in zip(rows, tables_of_page(), strict=True):
        for cell, page_cell in zip(printed, stated_row, strict=True):  # Another machine rounds differently.
            tolerance = 2.0 if cell.endswith("%") else 0.02
            assert number(cell) == pytest.approx(number(page_cell), abs=tolerance, nan_ok=True)
        assert [cell for cell in printed if math.isnan(number(cell))] == [
            cell for cell in stated_row if math.isnan(number(cell))
        ]
