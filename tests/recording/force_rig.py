"""Build a rig with one force sensor, which sends frames of rising counts by a script."""

import pytest

from tests.conftest import Lab
from tests.recording.scripted import Script
from tests.recording.test_reading import frames
from tests.recording.test_schedule import FORCE, RATE_HZ


def sending(lab: Lab, monkeypatch: pytest.MonkeyPatch, seconds: int) -> Script:
    """Write the rig file, and return the script by which its sensor sends for so many seconds."""
    new_script = Script(monkeypatch)
    new_script.send("force", frames(RATE_HZ * seconds), RATE_HZ)
    (lab.folder / "rig.toml").write_text(FORCE)
    return new_script
