"""Test that the loss of a device is reported and counted, and that no other stream suffers."""

import signal
import subprocess
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tacpipe.recording.station import LOST, OPENED
from tests.conftest import Lab, without_created_store
from tests.emulation.emulator import Emulator
from tests.recording import live


@pytest.fixture
def rig(lab: Lab) -> Iterator[Emulator]:
    with live.served(lab.folder, live.FORCE, live.SKIN, live.RANGE) as emulator:
        yield emulator


def plug(rig: Emulator, name: str, *, back: bool) -> None:
    """Take a device away, or bring it back, and wait until that has happened."""
    before = len(rig.ledger[name].events)
    (rig.replug if back else rig.unplug)(name)
    kind = "replug" if back else "unplug"
    live.awaited(lambda: kind in [event_kind for _, event_kind, _ in rig.ledger[name].events[before:]])


def enough(rig: Emulator, name: str, frames: int) -> None:
    before = len(rig.ledger[name].intact_rows)
    live.awaited(lambda: len(rig.ledger[name].intact_rows) > before + frames)


def start_recording(lab: Lab, rig: Emulator) -> subprocess.Popen[str]:
    process = live.started(lab.folder, "--name one")
    live.awaited(lambda: live.spools(lab.folder))
    for name in rig.rig.streams:
        enough(rig, name, 20)
    return process


def end_recording(process: subprocess.Popen[str]) -> str:
    process.send_signal(signal.SIGINT)
    _, err = process.communicate()
    assert process.returncode == 0, err
    return err


def numbers(rig: Emulator, shard: Any, name: str) -> list[int]:
    """Return which of the device's samples a counted stream recorded, each looked up with its values in the ledger."""
    ledger, modulus = rig.ledger[name], rig.rig.streams[name].sensor.counter
    samples = ledger.samples()
    assert samples.seq is not None and modulus is not None
    rows = live.sent(rig, name)
    rows_by_seq = {
        int(seq): (row, int(number))
        for seq, row, number in zip(samples.seq, rows, ledger.column("number")[ledger.intact_rows], strict=True)
    }
    counts = shard.table(name).column("seq").to_numpy() % modulus
    sent_samples = [rows_by_seq[int(seq)] for seq in counts]
    assert [row for row, _ in sent_samples] == live.recorded(shard, name)
    return [number for _, number in sent_samples]


@pytest.mark.parametrize("name", ["force", "skin"])
def test_a_device_that_is_plugged_in_again_goes_on_and_its_loss_is_exact(lab: Lab, rig: Emulator, name: str) -> None:
    process = start_recording(lab, rig)
    plug(rig, name, back=False)
    enough(rig, "range", 20)
    plug(rig, name, back=True)
    enough(rig, name, 40)
    end_recording(process)
    shard = live.only(lab.folder)

    events = live.events(shard, name)
    assert [cause for cause, _ in events if cause in (LOST, OPENED)] == [LOST, OPENED]
    skipped = int((np.diff(numbers(rig, shard, name)) - 1).sum())
    assert skipped > 0
    assert skipped == live.missing(shard, name) == shard.attributes[f"{name}_lost"] == sum(lost for _, lost in events)
    for other_name in {"force", "skin", "range"} - {name}:
        live.place(live.recorded(shard, other_name), live.sent(rig, other_name))


def test_a_device_that_does_not_count_is_lost_and_opened_too(lab: Lab, rig: Emulator) -> None:
    process = start_recording(lab, rig)
    plug(rig, "range", back=False)
    enough(rig, "force", 300)
    plug(rig, "range", back=True)
    enough(rig, "range", 20)
    end_recording(process)
    shard = live.only(lab.folder)

    events = live.events(shard, "range")
    assert [cause for cause, _ in events if cause in (LOST, OPENED)] == [LOST, OPENED]
    assert live.in_order(live.recorded(shard, "range"), live.sent(rig, "range"))
    assert shard.attributes["range_lost_estimated"] > 0


@pytest.mark.parametrize("name", ["force", "range"])
def test_a_device_that_is_away_at_the_end_is_an_error_and_the_rest_is_kept(lab: Lab, rig: Emulator, name: str) -> None:
    process = start_recording(lab, rig)
    plug(rig, name, back=False)
    enough(rig, "skin", 40)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate()
    shard = live.only(lab.folder)
    at = rig.rig.streams[name].address

    assert process.returncode == 5
    lines = without_created_store(err).splitlines()
    *events, first, second, third = lines
    assert len([line for line in events if f"Stream {name} ({at}) is lost" in line]) == 1
    assert first.startswith("one: ") and "force" in first
    assert second == "tacpipe: What came is recorded and kept, but streams were lost on the way."
    assert third.startswith(f"Stream {name} ({at}): there is no port ")
    assert [cause for cause, _ in live.events(shard, name) if cause in (LOST, OPENED)] == [LOST]
    for stream in rig.rig.streams:
        assert live.in_order(live.recorded(shard, stream), live.sent(rig, stream))
    assert not live.spools(lab.folder)


@pytest.mark.rig
def test_a_box_of_datagrams_that_went_mute_is_asked_anew(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tacpipe.recording.station.MUTE_S", 3.0)
    with live.served(lab.folder, live.WRENCH, live.FORCE) as rig:

        def happen() -> None:
            live.awaited(lambda: live.spools(lab.folder))
            enough(rig, "wrench", 50)
            plug(rig, "wrench", back=False)
            plug(rig, "wrench", back=True)  # it is as after a loss of power, and sends nothing until it is asked
            enough(rig, "wrench", 50)
            signal.raise_signal(signal.SIGINT)

        thread = threading.Thread(target=happen)
        thread.start()
        lab.run("acquire rig.toml -o rec")
        thread.join()
        shard = live.only(lab.folder)

        events = live.events(shard, "wrench")
        assert [cause for cause, _ in events if cause in (LOST, OPENED)] == [LOST, OPENED]
        skipped = int((np.diff(numbers(rig, shard, "wrench")) - 1).sum())
        assert skipped == live.missing(shard, "wrench") == sum(lost for _, lost in events)
        live.place(live.recorded(shard, "force"), live.sent(rig, "force"))
