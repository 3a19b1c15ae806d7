"""Trials in the layouts of the published sets, where a test wants them."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.formats import xela_files

Trial = Callable[..., Path]


@pytest.fixture
def flat_trial(tmp_path: Path) -> Trial:
    """Write a trial as the set of flat objects has it."""

    def make(name: str = "data_sample_2021-11-24-15-19-34", place: Path = tmp_path) -> Path:
        return xela_files.write_flat(place / name)

    return make


@pytest.fixture
def psc_trial(tmp_path: Path) -> Trial:
    """Write a trial as the slip control set has it."""

    def make(name: str = "data_sample_2022-02-21-09-58-49", place: Path = tmp_path) -> Path:
        return xela_files.write_psc(place / name)

    return make
