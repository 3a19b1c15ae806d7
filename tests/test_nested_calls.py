"""The annotation of an argument states the nested call that computes it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import pytest

from tacpipe.errors import TacpipeError
from tacpipe.plugins.stage import Fitted, Result, Values, stage

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Recording

    Parts = Dataset


@dataclass(frozen=True)
class Params:
    """No option."""


@stage(version=1)
def nested(params: Params, train: Dataset) -> Result:
    """Return nothing."""
    return Result()


def prepare(params: Params) -> dict[str, Values]:
    """Return one stage."""
    return {"synchronize": {}}


def fits(params: Params, recording: Recording, codec: Annotated[Fitted, nested]) -> Result:
    return Result()


def combines(params: Params, recordings: Annotated[Dataset, prepare], parts: Annotated[Parts, nested]) -> Result:
    return Result()


def lacks_stage(params: Params, recording: Recording, codec: Fitted) -> Result:
    return Result()


def names_nothing(params: Params, recording: Recording, codec: Annotated[Fitted, unknown]) -> Result:  # noqa: F821
    return Result()


def test_a_nested_stage_computes_the_files_or_the_parts_of_an_argument() -> None:
    fitting, combining = stage(version=1)(fits), stage(version=1)(combines)
    assert fitting.fit is nested and fitting.part is None and fitting.needs_split
    assert combining.part is nested and combining.fit is None and not combining.needs_split
    assert combining.arguments == {"recordings": "Dataset", "parts": "Parts"}


def test_a_function_states_the_stages_that_recordings_go_through_first() -> None:
    combining = stage(version=1)(combines)
    assert combining.prepare("recordings") is prepare and combining.prepare("parts") is None


def test_an_annotation_without_its_stage_or_with_an_unknown_name_is_refused() -> None:
    with pytest.raises(TacpipeError, match=r"codec as Fitted; it must be Annotated\[Fitted, STAGE\]"):
        stage(version=1)(lacks_stage).argument("Fitted")
    with pytest.raises(TacpipeError, match="names unknown, which its module does not define"):
        stage(version=1)(names_nothing).argument("Fitted")
