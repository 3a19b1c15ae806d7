"""Test that a recording gets a unique name on every file system: upper and lower case count as one."""

from pathlib import Path

import pytest

from tacpipe.errors import UsageError
from tacpipe.recording import appending
from tests.conftest import Lab
from tests.fake_recordings import write_dataset


@pytest.mark.parametrize(
    ("name", "existing_name"), [("cup", "Cup"), ("CUP", "Cup"), ("Cup-001", "cup-001"), ("STRASSE", "straße")]
)
def test_a_name_that_a_recording_has_but_for_case_is_refused_and_numbered_where_it_was_taken_meanwhile(
    lab: Lab, name: str, existing_name: str
) -> None:
    write_dataset(Path("rec"), {existing_name: ({}, {}), "another": ({}, {})})
    with pytest.raises(UsageError, match=f"with these names: {existing_name}"):
        appending.refuse_existing_names(Path("rec"), ["bowl", name])
    appending.refuse_existing_names(Path("rec"), ["bowl", f"{name}-2"])
    assert appending._free_name(name, lab.manifest("rec").recordings) == f"{name}-2"
