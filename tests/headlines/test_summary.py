"""The few numbers of ``summary.json``."""

import dataclasses
import json
import math

import pytest

from tacpipe.scores import headline
from tacpipe.scores.headline import Headline, HeadlineRow
from tests.test_headline import ONE


def headline_of_part(gain: float, part: str = "", target: str = "", error: float = 7.5) -> Headline:
    return dataclasses.replace(
        ONE, gain=gain, low=gain - 0.1, high=gain + 0.1, part=part, target=target, model=HeadlineRow("net", (error,))
    )


def test_the_gain_is_that_of_the_part_where_it_is_least() -> None:
    values = headline.summarize(
        [
            headline_of_part(0.3, "known objects"),
            headline_of_part(0.1, "unseen objects", error=9.0),
            headline_of_part(math.nan, "others"),
        ]
    )

    assert (values["gain"], values["low"], values["high"], values["n"]) == (0.1, 0.0, 0.2, 12)
    assert values["known_objects_mae_t_1"] == 7.5 and values["unseen_objects_mae_t_1"] == 9.0


def test_names_are_those_that_differ_and_may_be_given() -> None:
    headlines_of_targets = [
        headline_of_part(0.1, "novel objects", target) for target in ("PDC thumb", "electrodes thumb")
    ]

    assert list(headline.summarize(headlines_of_targets))[4:] == ["pdc_thumb", "electrodes_thumb"]
    assert list(headline.summarize(headlines_of_targets, {"PDC thumb": "pdc_th"}))[4:] == [
        "pdc_th",
        "electrodes_thumb",
    ]
    assert list(headline.summarize([headline_of_part(0.1)]))[4:] == ["mae_t_1"]


def test_what_is_not_defined_is_left_out_and_there_are_fewer_than_thirty() -> None:
    assert headline.summarize([]) == {}
    assert (
        "gain" not in headline.summarize([headline_of_part(math.nan)])
        and headline.summarize([headline_of_part(math.nan)])["n"] == 12
    )
    headlines_of_parts = [headline_of_part(0.1, f"part {number}") for number in range(100)]
    assert len(headline.summarize(headlines_of_parts)) < 30
    assert json.loads(headline.write_summary([headline_of_part(1 / 3)]))["gain"] == pytest.approx(1 / 3, rel=1e-5)
