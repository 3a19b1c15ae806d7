"""The command ``tacpipe limits``."""

import json
import math

import pytest

from tacpipe.cli import limits as command
from tacpipe.errors import UsageError
from tacpipe.metrics.intervals import Estimate
from tacpipe.tasks.touch.limits import NOTHING, Limits, Point, Repeatability

SKILL = dict.fromkeys(command.TARGETS, Estimate(0.31, 0.25, 0.38))
NEAR = dict.fromkeys(command.TARGETS, Repeatability(19, Estimate(0.6, -0.24, 0.93), Estimate(0.55, 0.22, 0.82)))
FAR = dict.fromkeys(command.TARGETS, Repeatability(0, NOTHING, NOTHING))
MEASURED = Limits({"cup": 9, "jar": 8}, [(0, 6, NEAR), (6, math.inf, FAR)], [Point(4, 8.0, SKILL)], SKILL, 2, 100)


def test_tables_hold_every_number_that_was_measured() -> None:
    lines = command.format_limits(MEASURED).splitlines()
    near = [line for line in lines if line.startswith("0 to 6")]
    assert [line.count("0.55 (0.22 to 0.82)") for line in near] == [4, 0]
    assert [line.count("0.60 (-0.24 to 0.93)") for line in near] == [0, 4]
    assert all(line.split()[3:] == ["0", "-", "-", "-", "-"] for line in lines if line.startswith("6 or more"))
    assert sum(line.count("0.31 (0.25 to 0.38)") for line in lines) == 8
    assert lines[0].split()[:4] == ["17", "grasps", "of", "2"]


def test_json_has_null_where_nothing_was_measured() -> None:
    tree = json.loads(json.dumps(MEASURED.to_json(), allow_nan=False))
    assert [row["high_mm"] for row in tree["repeatability"]] == [6, None]
    assert tree["repeatability"][1]["pair_skill"]["e_mf"] == {"mean": None, "low": None, "high": None}
    assert tree["learning_curve"] == [
        {"grasps": 4, "trained": 8.0, "skill": {name: estimate._asdict() for name, estimate in SKILL.items()}}
    ]


@pytest.mark.parametrize("sizes", ["", "0", "4,-1", "2.5", "four"])
def test_sizes_that_are_not_whole_numbers_from_one_are_refused(sizes: str) -> None:
    with pytest.raises(UsageError):
        command._parse_sizes(sizes)


def test_sizes_are_sorted_and_each_is_tried_once() -> None:
    assert command._parse_sizes("8, 2,8") == [2, 8]
