"""A live session of a model of materials, on an emulated BioTac that slides: what is published is recorded and predicted."""

import json
import os
import signal
import socket
from typing import Any

import numpy as np
import pytest

import tacpipe
from tacpipe.clouds import point_files
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.live.preparation import free_ports
from tacpipe.live.session import DIED, RESTARTED
from tacpipe.recording import rig as rig_of
from tacpipe.scores import calibration
from tacpipe.simulation.emulation.emulator import ReplayEmulator
from tacpipe.tasks.touch.live.messages import COLUMNS
from tests.conftest import Lab
from tests.live.sessions import commanded, ended, model_process, subscriber
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
        ReplayEmulator(rig, tacpipe.open("data/r"), lab.folder / "emulated") as emulator,
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


TOUCH_TRAINED = (
    "simulate touch --trials 12 --objects 1 --families sphere,box -o data/pinched",
    "segment grasps data/pinched -o data/g",
    "split data/g -o data/split --scheme random --val 0.2 --test 0",
    "train touch data/g --split data/split -o models/t --trees 10 --leaf 2",
)


def test_a_request_is_answered_with_what_predict_gives_and_both_are_recorded(lab: Lab) -> None:
    for command in TOUCH_TRAINED:
        lab.run(command)
    recordings = tacpipe.open(lab.folder / "data/g")
    name = sorted(recordings.recordings)[0]
    cloud, grasp = Cloud.from_table(recordings[name].table("cloud")), Grasp.from_table(recordings[name].table("grasp"))
    (lab.folder / "clouds").mkdir()
    (lab.folder / "clouds" / "cup.ply").write_bytes(point_files.pack_ply(cloud.points_m, cloud.colours))
    (port,) = free_ports(1)
    options = f'{{ folder = "{lab.folder / "clouds"}" }}'
    (lab.folder / "rig.toml").write_text(live.stream("requests", "grasps", f"udp:127.0.0.1:{port}", options))
    assert grasp.wrist is not None
    turned = Grasp(grasp.g2_m, grasp.g1_m, grasp.wrist @ np.diag([1.0, -1.0, -1.0]))
    content: dict[str, Any] = {
        "version": 1,
        "request": 7,
        "cloud": "cup.ply",
        "grasps": [
            {
                "g1": candidate.g1_m.tolist(),
                "g2": candidate.g2_m.tolist(),
                "wrist": np.asarray(candidate.wrist).tolist(),
            }
            for candidate in (grasp, turned)
        ],
    }
    with subscriber() as (heard, messages), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as planner:
        words = f"live rig.toml --model models/t -o rec --rank balance --json --publish udp:127.0.0.1:{heard}"
        process = commanded(lab, words)

        def answered() -> bool:
            assert process.poll() is None, process.communicate()[1]
            planner.sendto(json.dumps(content).encode(), ("127.0.0.1", port))
            return any(message["kind"] == "touch" for message in messages)

        live.awaited(answered)
        os.kill(model_process(process), signal.SIGKILL)
        count = len(messages)
        live.awaited(lambda: answered() and any(message["kind"] == "touch" for message in messages[count:]))
        ended(process, interrupt=True)
    answer = next(message for message in messages if message["kind"] == "touch")
    assert answer["cause"] == "" and answer["criterion"] == "balance"
    lab.run("predict models/t data/g -o predicted")
    (predicted,) = tacpipe.open(lab.folder / "predicted")
    table = predicted.table()
    row = table.column("recording").to_pylist().index(name)
    expected = np.array([table.column(column)[row].as_py() for column in COLUMNS], np.float32)
    touch = np.array([answer["candidates"][0]["touch"][column] for column in COLUMNS], np.float32)
    assert touch.tobytes() == expected.tobytes()
    shard = live.only(lab.folder)
    assert [cause for cause, _ in live.events(shard, "touch")][:2] == [DIED, RESTARTED]
    rows = shard.table("touch").to_pylist()
    assert (
        rows
        and {recorded_row["request"] for recorded_row in rows} == {7}
        and sorted({recorded_row["grasp"] for recorded_row in rows}) == [0, 1]
    )
    assert next(recorded_row for recorded_row in rows if recorded_row["rank"] == 1)["grasp"] == answer["best"]
    assert shard.table("requests")["g1_x_m"].to_pylist()[0] == content["grasps"][0]["g1"][0]
