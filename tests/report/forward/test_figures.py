from __future__ import annotations

import re

import numpy as np

from tacpipe.report.forward import figures

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
        figures.skill_of_methods({"a <b>": {"mean": [0.1, -3], "low": [0, -4], "high": [0.2, -2]}}, [20, 40], "ms"),
        figures.explained_variance([0.6, 0.3, 0.1], kept=2),
        figures.covariance(np.array([[2.0, -0.5], [-0.5, 0.0]])),
        figures.loss_by_width({"PCA": {2: 0.5, 8: 0.2}, "AE-C1": {8: 0.1}}),
        figures.losses(
            [{"epoch": 1, "train_loss": 0.2, "val_loss": 0.3}, {"epoch": 2, "train_loss": 0.1, "val_loss": 0.4}]
        ),
        figures.traces(np.arange(3.0), {"z00": np.arange(3.0)}, {"z00": {"t+1": np.array([0, np.nan, 2])}}),
    ]
    for one in drawn:
        assert one.startswith("<svg role=")
        assert "metadata" not in one
        assert "http" not in re.sub(r'xmlns(:xlink)?="[^"]+"', "", one)


def test_methods_keep_their_line_from_figure_to_figure() -> None:
    told = {"mean": [0.1, 0.2], "low": [0.0, 0.1], "high": [0.2, 0.3]}
    first, second = (
        figures.skill_of_methods(dict.fromkeys(names, told), [20, 40], "ms", order=["a", "b"]) for names in ("a", "b")
    )
    assert ("var(--model)" in first, "var(--codec)" in first) == (True, False)
    assert ("var(--model)" in second, "var(--codec)" in second) == (False, True)


def test_a_covariance_shows_its_sign_by_colour_and_nothing_by_none() -> None:
    drawn = figures.covariance(np.array([[4.0, -1.0], [-1.0, 0.0]]))
    assert drawn.count("fill: var(--model)") == 1
    assert drawn.count("fill: var(--persistence); opacity: 0.5") == 2  # the square root of 1 / 4


def test_one_method_that_is_far_off_does_not_press_the_others_into_one_line() -> None:
    far = {"mean": [-1000.0, -500.0], "low": [-2000.0, -900.0], "high": [-800.0, -400.0]}
    near = {"mean": [0.1, 0.2], "low": [float("nan")] * 2, "high": [float("nan")] * 2}
    drawn = figures.skill_of_methods({"near": near, "far": far}, [20, 40], "ms")
    ticks = [float(found.replace("−", "-")) for found in re.findall(r">([−\d.]+)</text>", drawn)]
    assert [tick for tick in ticks if tick < 20] and all(-1 <= tick <= 0.25 for tick in ticks if tick < 20)
    assert "−500" not in drawn
