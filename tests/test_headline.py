"""A headline states the best model against the best baseline, as a sentence and as a table."""

import dataclasses
import math

import pytest

from tacpipe.cli import headline_table
from tacpipe.metrics import headline
from tacpipe.metrics.headline import Headline, HeadlineRow

ONE = Headline(
    "forward",
    "net",
    "unseen objects",
    "",
    ("MAE t+1",),
    "counts",
    "the squared error",
    HeadlineRow("net", (7.5,)),
    (HeadlineRow("ridge", (8.25,)), HeadlineRow("persistence", (9.0,))),
    "skill",
    0.1,
    0.02,
    0.2,
    12,
    "recordings",
    3,
    1,
    9.5,
)


def headline_with(**changes: object) -> Headline:
    return dataclasses.replace(ONE, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("low", "high", "verdict", "words"),
    [
        (
            0.02,
            0.2,
            "better",
            "is better than the baseline ridge, the best of 2 baselines: skill +0.100 (+0.020 to +0.200, ",
        ),
        (-0.2, -0.1, "worse", "is worse than the baseline ridge"),
        (-0.1, 0.2, "unclear", "does not differ measurably from the baseline ridge"),
        (0.0, 0.2, "unclear", "does not differ measurably"),
    ],
)
def test_a_verdict_needs_an_interval_that_excludes_zero(low: float, high: float, verdict: str, words: str) -> None:
    better_or_worse = headline_with(low=low, high=high)
    assert better_or_worse.verdict == verdict
    assert headline.sentence(better_or_worse).startswith(f"Unseen objects: net {words}")
    assert "95 % interval over 12 recordings" in headline.sentence(better_or_worse)


@pytest.mark.parametrize("clusters", [1, 2, 5])
def test_few_recordings_give_no_verdict_whatever_their_interval(clusters: int) -> None:
    few_recordings = headline_with(clusters=clusters)
    assert few_recordings.verdict == ""
    assert "too few for a verdict" in headline.sentence(few_recordings)
    assert headline_with(clusters=headline.MIN_CLUSTERS).verdict == "better"


def test_without_a_baseline_nothing_is_claimed() -> None:
    nan = float("nan")
    without_baseline = headline_with(baselines=(), gain=nan, low=nan, high=nan)
    assert without_baseline.verdict == "" and without_baseline.best is None
    assert (
        headline.sentence(without_baseline) == "Unseen objects: net was evaluated without a baseline, on 12 recordings."
    )


def test_several_are_better_together_only_where_each_is() -> None:
    better, unclear, worse = headline_with(), headline_with(low=-0.1), headline_with(low=-0.2, high=-0.1)
    assert headline.verdict([better, better]) == "better"
    assert headline.verdict([worse, worse]) == "worse"
    assert headline.verdict([better, unclear]) == headline.verdict([better, worse]) == "unclear"
    assert headline.verdict([better, headline_with(clusters=2)]) == "unclear"
    assert headline.verdict([]) == ""


def test_headlines_are_read_as_they_were_written() -> None:
    undefined = headline_with(gain=float("nan"), model=HeadlineRow("net", (float("nan"),)))
    (first, second) = headline.read(headline.write([ONE, undefined]))
    assert first == ONE
    assert math.isnan(second.gain) and math.isnan(second.model.values[0])
    assert b"NaN" not in headline.write([undefined])
    assert ONE.to_json()["best_baseline"] == "ridge" and ONE.to_json()["verdict"] == "better"


def test_the_table_has_the_model_above_its_best_baseline_and_how_the_interval_was_made() -> None:
    lines = headline_table.text([ONE, headline_with(part="known objects", seeds=3)]).splitlines()
    assert lines[0].split() == ["MAE", "t+1", "skill", "95", "%", "interval", "n"]
    assert lines[1] == "unseen objects"
    assert lines[2].split() == ["net", "7.5", "+0.100", "+0.020", "to", "+0.200", "12"]
    assert lines[3].split() == ["vs", "ridge", "8.25", "model", "is", "better"]
    assert lines[4] == "known objects"
    notes = " ".join(lines[7:])
    assert "n: recordings. vs: the best of 2 baselines." in notes
    assert "1 − error / error of the best baseline; the error is the squared error" in notes
    assert "jackknife over recordings or recordings and seeds" in notes
    assert headline_table.text([]) == headline_table.EMPTY


def test_the_table_fits_the_width_and_keeps_the_error_that_ranks_and_the_interval() -> None:
    columns = ("MAE t+1", "MAE t+3", "MAE t+5", "MAE t+10", "vs persistence")
    rows = [HeadlineRow(name, (5.7, 13.39, 21.85, 40.87, 0.3803)) for name in ("taxelwise · raw", "last_value_linear")]
    wide = headline_with(
        columns=columns, model=rows[0], baselines=(rows[1],), method="taxelwise · raw", low=-0.068, high=0.025
    )
    for width, expected_columns in ((120, columns), (80, ("MAE t+1", "vs persistence"))):
        lines = headline_table.text([wide], width).splitlines()
        assert max(map(len, lines)) <= width
        assert [name for name in columns if name in lines[0]] == list(expected_columns)
        assert "−0.068 to +0.025" in lines[2]
