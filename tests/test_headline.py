"""A headline states the best model against the best baseline, as a sentence and as a table."""

import dataclasses
import math

import pytest

from tacpipe.cli import headline_table
from tacpipe.scores import headline, words
from tacpipe.scores.headline import Headline, HeadlineRow

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
    ("low", "high", "verdict", "expected"),
    [
        (
            0.02,
            0.2,
            "better",
            ", the best of 2 baselines, on 12 recordings: better (95 % interval: 2.0 to 20.0 % less).",
        ),
        (-0.2, -0.1, "worse", "worse (95 % interval: 20.0 to 10.0 % more)."),
        (-0.1, 0.2, "unclear", "no measurable difference (95 % interval: 10.0 % more to 20.0 % less)."),
        (0.0, 0.2, "unclear", "no measurable difference"),
    ],
)
def test_a_verdict_needs_an_interval_that_excludes_zero(low: float, high: float, verdict: str, expected: str) -> None:
    better_or_worse = headline_with(low=low, high=high)
    assert better_or_worse.verdict == verdict
    assert words.sentence(better_or_worse).startswith("Unseen objects: net has 10.0 % less error than ridge")
    assert expected in words.sentence(better_or_worse)


@pytest.mark.parametrize("clusters", [1, 2, 5])
def test_few_recordings_give_no_verdict_whatever_their_interval(clusters: int) -> None:
    few_recordings = headline_with(clusters=clusters)
    assert few_recordings.verdict == ""
    assert words.sentence(few_recordings).endswith("promising, not proven (6 recordings are needed).")
    assert headline_with(clusters=headline.MIN_CLUSTERS).verdict == "better"


def test_without_a_baseline_nothing_is_claimed() -> None:
    nan = float("nan")
    without_baseline = headline_with(baselines=(), gain=nan, low=nan, high=nan)
    assert without_baseline.verdict == "" and without_baseline.best is None
    assert words.sentence(without_baseline) == "Unseen objects: net was evaluated without a baseline, on 12 recordings."


def test_more_than_three_headlines_are_counted_by_verdict_and_the_weakest_is_a_sentence() -> None:
    worse = headline_with(part="known objects", gain=-0.1, low=-0.2, high=-0.05)
    lines = words.summary([ONE, ONE, worse, headline_with(clusters=2)])
    assert lines[0] == "4 comparisons with the best baseline: 2 better, 1 worse, 1 not proven. The weakest:"
    assert lines[1:] == [words.sentence(worse)] and "has 10.0 % more error" in lines[1]
    assert words.summary([ONE, worse]) == [words.sentence(ONE), words.sentence(worse)]


def test_several_targets_are_named_by_verdict_in_the_words_of_a_single_one() -> None:
    named = [headline_with(target=target) for target in ("x", "y", "z")]
    assert words.clause_of_targets(named) == "is better than the best baseline on all 3 targets (12 recordings)"
    unproven = [dataclasses.replace(headline, clusters=2) for headline in named]
    assert words.clause_of_targets(unproven) == (
        "is promising, not proven, on all 3 targets (2 recordings; 6 recordings are needed)"
    )
    assert words.judgement(unproven[0]).startswith("promising, not proven")
    mixed = [named[0], dataclasses.replace(named[1], low=-0.1), dataclasses.replace(unproven[2], gain=-0.1)]
    assert words.clause_of_targets(mixed).startswith(
        "is better than the best baseline on x and not measurably different from the best baseline on y and without a "
    )
    assert words.clause_of_targets(named[:1]) == words.clause(named[0])


def test_gains_in_points_and_areas_have_their_own_words() -> None:
    points = headline_with(measure="points", gain=22.2, low=-2.1, high=43.5)
    assert "net is right 22.2 points more often than ridge" in words.sentence(points)
    assert "(95 % interval: 2.1 points less to 43.5 points more)" in words.sentence(points)
    area = headline_with(measure="area", gain=-0.05, low=-0.1, high=-0.01)
    assert "net has 0.050 less area than ridge" in words.sentence(area)
    assert "worse (95 % interval: 0.100 to 0.010 less)" in words.sentence(area)
    assert "net is right as often as ridge" in words.sentence(headline_with(measure="points", gain=0.0))


def test_headlines_are_read_as_they_were_written() -> None:
    undefined = headline_with(gain=float("nan"), model=HeadlineRow("net", (float("nan"),)))
    (first, second) = headline.read(headline.write([ONE, undefined]))
    assert first == ONE
    assert math.isnan(second.gain) and math.isnan(second.model.values[0])
    assert b"NaN" not in headline.write([undefined])
    assert ONE.to_json()["best_baseline"] == "ridge" and ONE.to_json()["verdict"] == "better"


def test_the_table_has_the_model_above_its_best_baseline_and_how_the_interval_was_made() -> None:
    text = headline_table.text([ONE, headline_with(part="known objects", seeds=3)])
    sentences, _, rest = text.partition("\n\n")
    assert sentences.startswith("Unseen objects: net has") and "20.0 % less, 3 seeds)." in sentences
    lines = rest.splitlines()
    assert lines[0].split() == ["MAE", "t+1", "less", "error", "95", "%", "interval", "n"]
    assert lines[1] == "unseen objects"
    assert lines[2].split() == ["net", "7.5", "+10.0", "%", "+2.0", "to", "+20.0", "%", "12"]
    assert lines[3].split() == ["than", "ridge", "8.25", "better"]
    assert lines[4] == "known objects"
    notes = " ".join(lines[7:])
    assert "n: recordings. Than: the best of 2 baselines." in notes
    assert "1 − error / error of the best baseline; the error is the squared error" in notes
    assert "jackknife over recordings or recordings and seeds" in notes
    assert headline_table.text([]) == headline_table.EMPTY


def test_the_table_fits_the_width_and_keeps_the_error_that_ranks_and_the_interval() -> None:
    columns = ("MAE t+1", "MAE t+3", "MAE t+5", "MAE t+10", "vs persistence")
    rows = [HeadlineRow(name, (5.7, 13.39, 21.85, 40.87, 0.3803)) for name in ("taxelwise · raw", "last_value_linear")]
    wide = headline_with(
        columns=columns, model=rows[0], baselines=(rows[1],), method="taxelwise · raw", low=-0.068, high=0.025
    )
    heads = [*columns[:-1], "than persistence"]
    for width, expected_heads in ((140, heads), (90, ("MAE t+1", "than persistence"))):
        lines = headline_table.table([wide]).text(width).splitlines()
        assert max(map(len, lines)) <= width
        assert lines[0].split() == ["less", "error"]
        assert [name for name in heads if name in lines[1]] == list(expected_heads)
        assert "−6.8 to +2.5 %" in lines[3] and "38.0 %" in lines[3]
