"""Intervals of recordings: `tacpipe label --interval`, `--intervals`, and what shows them."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.datasets import intervals
from tests.conftest import Lab

TIMES = st.tuples(st.integers(0, 1000), st.integers(0, 1000)).map(lambda pair: (min(pair) / 8, max(pair) / 8))


@given(st.lists(TIMES, max_size=6))
def test_a_text_reads_back_as_the_union_of_its_intervals(times: list[tuple[float, float]]) -> None:
    again = intervals.from_text(intervals.to_text(times))
    moments = [eighth / 8 for eighth in range(1001)]

    def covered(parts: list[tuple[float, float]]) -> list[bool]:
        return [any(begin <= moment <= end for begin, end in parts) for moment in moments]

    assert covered(again) == covered(times)
    assert all(first[1] < second[0] for first, second in itertools.pairwise(again))


def labels(lab: Lab) -> dict[str, Any]:
    recordings = lab.manifest("data/r").recordings
    return {name: entry["attributes"].get("slip_intervals") for name, entry in recordings.items()}


def test_an_interval_is_added_to_those_of_the_named_recordings(toys: Lab) -> None:
    toys.run("label data/r trial-000 --interval slip 1.5 2")
    toys.run("label data/r 'trial-00[01]' --interval slip 0.25 0.5")
    assert labels(toys) == {"trial-000": "0.25-0.5 1.5-2", "trial-001": "0.25-0.5", "trial-002": None}


def test_a_file_replaces_the_intervals_of_the_recordings_that_it_names(toys: Lab) -> None:
    toys.run("label data/r 'trial-*' --interval slip 9 10")
    Path("slips.csv").write_text(
        "recording,interval,from_s,to_s\ntrial-000,slip,1,2\ntrial-000,slip,4,4.5\ntrial-001,slip,,\n"
    )
    toys.run("label data/r --intervals slips.csv")
    assert labels(toys) == {"trial-000": "1-2 4-4.5", "trial-001": "", "trial-002": "9-10"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("label data/r trial-000 --interval slip 2 1", "the smaller one first"),
        ("label data/r trial-000 --interval slip nan 1", "the smaller one first"),
        ("label data/r --interval slip 1 2", "Name the recordings to label"),
        ("label data/r trial-000 --interval 'a slip' 1 2", "is not a name for intervals"),
        ("label data/r trial-009 --interval slip 1 2", "has no recording trial-009"),
        ("label data/r --intervals slips.csv --interval slip 1 2", "--intervals names recordings and labels itself"),
        ("label data/r --intervals slips.csv", "and the dataset has no such recording"),
        ("label data/r --intervals bad.csv", "is not an interval. Give seconds as numbers"),
        ("label data/r --intervals heads.csv", "it must have recording, interval, from_s, to_s"),
    ],
)
def test_intervals_that_mean_nothing_are_refused(toys: Lab, words: str, message: str) -> None:
    heads = "recording,interval,from_s,to_s\n"
    Path("slips.csv").write_text(f"{heads}trial-077,slip,1,2\n")
    Path("bad.csv").write_text(f"{heads}trial-000,slip,one,2\n")
    Path("heads.csv").write_text("recording,begin,end\ntrial-000,1,2\n")
    ran = toys.call(words)
    assert ran.code == 2
    assert message in " ".join(ran.err.split())
    assert labels(toys) == dict.fromkeys(labels(toys))


def test_show_lists_the_intervals_of_a_recording(toys: Lab) -> None:
    toys.run("label data/r trial-000 --interval slip 0.01 0.02")
    spans = toys.run_json("show data/r trial-000")["label_spans"]
    assert [(span["name"], round(span["start_s"], 6), round(span["stop_s"], 6)) for span in spans] == [
        ("slip", 0.01, 0.02)
    ]
