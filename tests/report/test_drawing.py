"""What all figures have in common."""

from __future__ import annotations

import re
from typing import Any

from tacpipe.report import drawing


def line(axes: list[Any]) -> None:
    axes[0].plot([0, 1], [0, 1], color=drawing.COLOURS["model"])
    axes[0].set_xlabel("time (s)")


def test_the_same_numbers_give_the_same_bytes_and_carry_no_dates() -> None:
    first, second = (drawing.svg(line, "a line", size=(3, 2)) for _ in range(2))
    assert first == second
    assert first.startswith('<svg role="img" aria-label="a line"')
    assert "metadata" not in first


def test_colours_are_the_pages_variables_and_text_stays_text() -> None:
    drawn = drawing.svg(line, "a line", size=(3, 2))
    assert "var(--model)" in drawn and "currentColor" in drawn
    assert not re.search(r"#01020\d|#01030\d", drawn)
    assert "time (s)</text>" in drawn
