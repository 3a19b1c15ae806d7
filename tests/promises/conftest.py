"""A sound project that took some seconds to make, and copies of it to be harmed."""

from pathlib import Path

import pytest

from tests.conftest import Lab, make_once
from tests.promises import specimen
from tests.promises.specimen import Specimen


@pytest.fixture
def original(lab: Lab, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sound project."""

    def make(folder: Path) -> None:
        specimen.make(lab)
        specimen.clone(lab.folder, folder)

    return make_once(tmp_path_factory, "specimen", make)


@pytest.fixture
def project(original: Path, lab: Lab) -> Specimen:
    """A copy of a sound project."""
    return specimen.copy(original, lab)
