"""A project with two recordings."""

import pytest

from tests.conftest import Lab
from tests.exports import recordings
from tests.fake_recordings import write_dataset


@pytest.fixture
def rig(lab: Lab) -> Lab:
    """A project with the dataset ``rec`` of two recordings of three streams."""
    write_dataset(lab.folder / "rec", recordings.trials())
    return lab
