"""A live session of a model of materials, on an emulated BioTac that slides: what is published is recorded and predicted."""

import numpy as np
import pytest

import tacpipe
from tacpipe.metrics import calibration
from tacpipe.recording import rig as rig_of
from tacpipe.simulation.emulation.emulator import Emulator
from tests.conftest import Lab
from tests.live.sessions import commanded, ended, subscriber
from tests.recording import live

pytestmark = [pytest.mark.rig, pytest.mark.long]
TRAINED = (
    "simulate material --trials 24 --materials 3 -o data/r",
    "segment slides data/r -o data/s --frames 150",
    "split data/s -o data/split --scheme random --val 0.2 --test 0",
    "train material data/s --split data/split -o models/m --architecture statistics --sensors biotac",
)


def test_the_last_answer_of_a_session_is_what_predict_gives_its_recording(lab: Lab) -> None:
    for command in TRAINED:
        lab.run(command)
    rig = rig_of.read(live.ROOT / "rigs" / "slide.toml")
    with (
        Emulator(rig, 5, folder=lab.folder / "emulated", patient=True) as emulator,
        subscriber() as (port, messages),
    ):
        (lab.folder / "rig.toml").write_text(rig_of.to_toml(emulator.rig))
        words = f"live rig.toml --model models/m -o rec --json --publish udp:127.0.0.1:{port}"
        process = commanded(lab, words)
        live.awaited(lambda: sum(message.get("seen") == 1.0 for message in messages) > 5 or process.poll() is not None)
        printed = ended(process, interrupt=True)
        live.awaited(lambda: messages[-1].get("state") == "final")
    answers = [message for message in messages if message["kind"] == "material"]
    assert messages[0]["materials"] == ["1", "2", "3"] and messages[0]["confidence"] == "order"
    assert answers[0]["material"] == "unknown" or answers[0]["seen"] >= 0.25
    final = answers[-1]
    lab.run("predict models/m rec -o predicted")
    (predicted,) = tacpipe.open("predicted")
    table = predicted.table()
    names = [name for name in table.column_names if name.startswith("score_")]
    expected = calibration.probabilities(np.column_stack([table.column(name).to_numpy() for name in names]))[0].astype(
        np.float32
    )
    assert np.array_equal(np.array(list(final["probabilities"].values()), np.float32), expected)
    assert final["material"] == str(table.column("material")[0].as_py())
    assert printed["live"]["states"]["material"].startswith(final["material"])
    shard = live.only(lab.folder)
    recorded = {row["t_device_ns"]: row for row in shard.table("material").to_pylist()}
    heard = [message for message in answers if message["t_ns"] in recorded]
    assert len(recorded) > 5 and len(heard) == len(recorded)
    for message in heard:
        number = -1 if message["probabilities"] is None else messages[0]["materials"].index(message["material"])
        assert recorded[message["t_ns"]]["class"] == number and recorded[message["t_ns"]]["rows"] == message["rows"]
