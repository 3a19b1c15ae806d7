"""Mark tests that record emulated devices in real time as a tier of their own, with limits that measure no computer."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.conftest import Lab
from tests.emulation.emulator import Emulator
from tests.recording import force_rig, live, patient
from tests.recording.scripted import Script

SERVED = {"acquired", "rig", "served"}  # fixtures that emulate devices


@pytest.hookimpl(tryfirst=True)  # it adds markers before the selection by markers
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    folder = str(Path(__file__).parent)
    for item in items:
        if SERVED & set(getattr(item, "fixturenames", ())) and str(item.path).startswith(folder):
            item.add_marker("rig")


@pytest.fixture(autouse=True)
def patience(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have devices that are emulated in real time awaited for as long as it takes."""
    if request.node.get_closest_marker("rig"):
        patient.relax(monkeypatch)


@pytest.fixture
def rig(lab: Lab) -> Iterator[Emulator]:
    with live.served(lab.folder, live.FORCE) as emulator:
        yield emulator


@pytest.fixture
def script(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> Script:
    """A rig whose force sensor sends for 20 s."""
    return force_rig.sending(lab, monkeypatch, 20)
