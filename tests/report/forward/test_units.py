"""Errors on the page stand in the unit of the channels."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import pytest

from tacpipe.report import forward
from tests.report.forward.result_fakes import result


def shown(results: Sequence[Any]) -> str:
    """Return the text of the part of the page, tags and drawings left out."""
    page = re.sub(r"<svg.*?</svg>", " ", forward.report(results, [], 0), flags=re.DOTALL)
    return re.sub(r"<[^>]+>", " ", page)


def of(unit: str | None, seed: int = 0, codec: str = "raw") -> Any:
    return result(codec, seed, ratio=0.5, attributes={}, inputs={} if unit is None else {"unit": unit})


@pytest.mark.parametrize("several", [False, True])
def test_results_of_a_sensor_in_kilopascal_name_no_count(several: bool) -> None:
    page = shown([of("kPa"), *([of("kPa", 1), of("kPa", 0, "PCA-8")] if several else [])])
    assert "kPa" in page and "kPa²" in page
    assert not re.findall(r"\bcounts²?\b", page)


def test_results_without_a_unit_are_in_counts_as_before() -> None:
    page = shown([of(None), of(None, 1)])
    assert "(counts)" in page and "counts²" in page and "Units: counts" in page


def test_results_of_several_units_are_each_in_their_own() -> None:
    page = shown([of("kPa"), of("N", 0, "PCA-8")])
    assert "own units" in page
    assert {"Units: kPa", "Units: N"} <= set(re.findall(r"Units: \w+", page))
