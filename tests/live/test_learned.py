"""A live session of a model of forces on an emulated rig: what is published is recorded, and follows from the recording."""

import re

import numpy as np
import pytest

import tacpipe
from tacpipe.recording import rig as rig_of
from tacpipe.simulation.emulation.emulator import ReplayEmulator
from tests.conftest import Lab
from tests.live.sessions import commanded, ended, subscriber
from tests.recording import live

pytestmark = [pytest.mark.rig, pytest.mark.long]
TRAINED = (
    "simulate forward --trials 4 --duration-s 4 --robot-rate-hz 200 -o data/r",
    "synchronize data/r -o data/synced",
    "split data/synced -o data/split --scheme random --val 0 --test 0.25",
    "train regress data/synced --split data/split --target gt_finger?_normal_n --context-s 0.1 --architecture linear "
    "--rest-s 0.2 -o models/force",
)


def test_published_forces_are_recorded_and_are_those_that_predict_gives_for_the_recording(lab: Lab) -> None:
    for command in TRAINED:
        lab.run(command)
    rig = rig_of.read(live.ROOT / "rigs" / "first-paper.toml")
    with (
        ReplayEmulator(rig, tacpipe.open("data/r"), lab.folder / "emulated") as emulator,
        subscriber() as (port, messages),
    ):
        (lab.folder / "rig.toml").write_text(rig_of.to_toml(emulator.rig))
        process = commanded(lab, f"live rig.toml --model models/force -o rec --json --publish udp:127.0.0.1:{port}")
        live.awaited(
            lambda: sum(bool(message.get("values")) for message in messages) > 100 or process.poll() is not None
        )
        printed = ended(process, interrupt=True)
    assert messages[0]["targets"] == {"gt_finger1_normal_n": "N", "gt_finger2_normal_n": "N"}
    shard = live.only(lab.folder)
    recorded = {row["t_device_ns"]: row for row in shard.table("estimate").to_pylist()}
    answered = [message for message in messages if message.get("values") and message["t_ns"] in recorded]
    assert len(answered) > 80 and printed["live"]["late"] == 0
    for message in answered:
        assert all(recorded[message["t_ns"]][name] == value for name, value in message["values"].items())
    lab.run("predict models/force rec -o predicted --causal")
    evaluated = lab.run("evaluate models/force rec --live -o results").err
    compared = re.search(r"(\d+) of (\d+) published answers are what", evaluated)
    assert compared and compared[1] == compared[2] and int(compared[2]) > 80
    (predicted,) = tacpipe.open("predicted")
    table = predicted.table()
    expected = dict(zip(table["t_ns"].to_pylist(), table["gt_finger1_normal_n"].to_pylist(), strict=True))
    values = np.array([message["values"]["gt_finger1_normal_n"] for message in answered])
    assert values.tolist() == [expected[message["t_ns"]] for message in answered]

    with subscriber() as (port, messages):  # the recordings themselves are a rig
        options = f"--model models/force --json --publish udp:127.0.0.1:{port}"
        process = commanded(lab, f"live --replay data/r {options}")
        live.awaited(
            lambda: sum(bool(message.get("values")) for message in messages) > 20 or process.poll() is not None
        )
        ended(process, interrupt=True)
    assert sum(bool(message.get("values")) for message in messages) > 20
    refused = lab.call("live --model models/force")
    assert refused.code == 2 and "--replay" in refused.err
