from __future__ import annotations

import re
from pathlib import Path

import pytest

from tacpipe.channels import schema

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "recordings.md"


def test_the_quantities_of_the_page_of_formats_are_the_vocabulary() -> None:
    (row,) = (line for line in PAGE.read_text().splitlines() if line.startswith("| `quantity` |"))
    assert set(re.findall(r"`([a-z_]+)`", row)) - {"quantity"} == schema.QUANTITIES


@pytest.mark.parametrize(
    ("word", "symbol"),
    [
        ("Newton", "N"),
        ("counts", "count"),
        ("Celsius", "degC"),
        ("millimeters", "mm"),
        ("kpa", "kPa"),
        ("rad/s", "rad/s"),
    ],
)
def test_a_unit_that_is_spelled_out_is_suggested_as_its_symbol(word: str, symbol: str) -> None:
    assert schema.unit_from_text(word) == symbol
    assert schema.describe_unknown_unit(word) == (
        "" if word == symbol else f"There is no unit {word}. Did you mean {symbol}?"
    )


@pytest.mark.parametrize("unit", ["m/s^2", "N m", "1/s", "µN", "mPa s", "W/m²", "gf", "%", "count/N", "N/mm^2", "kΩ"])
def test_products_and_quotients_of_symbols_are_units(unit: str) -> None:
    assert schema.is_unit(unit) and not schema.is_unit(f"{unit}x") and not schema.is_unit(f"foo {unit}")
