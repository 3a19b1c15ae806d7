from __future__ import annotations

import re

import numpy as np

from tacpipe.report import figures

ERRORS = {"model": [1.0, 2.0], "persistence": [2.0, 3.0], "codec": [0.5, 0.5], "mine": [1.5, 1.5]}


def test_the_same_numbers_give_the_same_bytes() -> None:
    assert figures.errors_by_horizon(ERRORS, [20, 40], "counts") == figures.errors_by_horizon(
        ERRORS, [20, 40], "counts"
    )


def test_colours_follow_the_theme_and_text_stays_text() -> None:
    drawn = figures.errors_by_horizon(ERRORS, [20, 40], "counts")
    assert "var(--model)" in drawn
    assert "currentColor" in drawn
    assert not re.search(r"#01020\d|#01030\d", drawn)
    assert "time ahead (ms)" in drawn


def test_figures_carry_neither_dates_nor_outside_resources() -> None:
    drawn = [
        figures.skill_by_horizon({"mean": [0.1, 0.2], "low": [0.0, 0.1], "high": [0.2, 0.3]}, [20, 40]),
        figures.skill_by_trial([0.3, -0.1], [10, 20]),
        figures.losses(
            [{"epoch": 1, "train_loss": 0.2, "val_loss": 0.3}, {"epoch": 2, "train_loss": 0.1, "val_loss": 0.4}]
        ),
        figures.traces(np.arange(3.0), {"z00": np.arange(3.0)}, {"z00": {"t+1": np.array([0, np.nan, 2])}}),
    ]
    for one in drawn:
        assert one.startswith("<svg role=")
        assert "metadata" not in one
        assert "http" not in re.sub(r'xmlns(:xlink)?="[^"]+"', "", one)
