"""A failure in a live session costs forecasts with a stated cause; the recording continues, and so does the session.

Nothing here goes by the clock: a forecast is held against the arrival of what it was made from, in the recording.
"""

import json
import os
import signal
import socket
import threading
from typing import Any

import numpy as np
import pytest

from tacpipe.live.session import DIED, RESTARTED
from tests.conftest import Lab
from tests.emulation.byte_faults import Faults
from tests.live.persistent import GAP_NS, PERIOD_NS
from tests.live.sessions import await_from, ended, forecasts, model_process, started, subscriber, whole
from tests.live.test_publishers import HANDSHAKE
from tests.recording import live, patient

pytestmark = pytest.mark.rig
SKIN = live.stream("skin", "xela", "ws:127.0.0.1:5000", "{ rate_hz = 50 }")


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    patient.relax(monkeypatch)


def without(messages: list[dict[str, Any]], stream: str) -> list[dict[str, Any]]:
    """Return the messages without a forecast whose cause names a stream."""
    return [
        message
        for message in messages
        if message["kind"] == "forecast" and message["values"] is None and stream in message["cause"]
    ]


def test_a_stream_that_stalls_costs_the_forecasts_of_that_time(lab: Lab) -> None:
    faults = Faults(stall=0.7, stall_s=0.6)
    with live.served(lab.folder, SKIN, live.WRENCH, faults=faults), subscriber() as (port, messages):
        process = started(lab, f"-o rec --json --publish udp:127.0.0.1:{port}")
        await_from(process, lambda: without(messages, "skin"))
        count = messages.index(without(messages, "skin")[0])
        await_from(process, lambda: len(forecasts(messages[count:])) > 20)
        printed = ended(process, interrupt=True)
    shard = live.only(lab.folder)
    arrivals = shard.table("skin").column("t_ns").to_numpy()
    points = shard.table("forecast").column("t_device_ns").to_numpy()
    newest = arrivals[np.searchsorted(arrivals, points, side="right") - 1]
    assert ((points - newest) <= GAP_NS).all()  # a sample was due a period after the newest
    assert GAP_NS <= 3 * PERIOD_NS and 0 < len(points) <= printed["live"]["forecasts"]
    assert whole(shard, "skin") and whole(shard, "wrench")


def test_a_device_whose_clock_is_set_anew_changes_no_forecast(lab: Lab) -> None:
    faults = Faults(clock_step=1.0, clock_step_ms=5000.0)
    with live.served(lab.folder, SKIN, faults=faults), subscriber() as (port, messages):
        process = started(lab, f"-o rec --json --publish udp:127.0.0.1:{port}")
        await_from(process, lambda: len(forecasts(messages)) > 150)
        printed = ended(process, interrupt=True)
    shard = live.only(lab.folder)
    steps_ns = np.diff(shard.table("skin").column("t_device_ns").to_numpy())
    assert (np.abs(steps_ns) > 10**9).any()
    assert {message["cause"] for message in forecasts(messages)} == {""}
    points = shard.table("forecast").column("t_device_ns").to_numpy()
    skipped = printed["live"]["skipped"]
    assert (np.diff(points) > 0).all() and ((points - points[0]) % PERIOD_NS == 0).all()
    gaps = len([message for message in messages if message["kind"] == "forecast" and message["values"] is None])
    assert (points[-1] - points[0]) // PERIOD_NS + 1 <= len(points) + skipped + gaps


def test_a_model_process_that_is_killed_is_replaced_by_one_that_continues_its_grid(lab: Lab) -> None:
    with live.served(lab.folder, SKIN, live.WRENCH), subscriber() as (port, messages):
        process = started(lab, f"-o rec --json --publish udp:127.0.0.1:{port}")
        await_from(process, lambda: len(forecasts(messages)) > 30)
        os.kill(model_process(process), signal.SIGKILL)
        count = len(messages)
        await_from(process, lambda: any(message["kind"] == "description" for message in messages[count:]))
        await_from(process, lambda: len(forecasts(messages[count:])) > 30)
        printed = ended(process, interrupt=True)
    shard = live.only(lab.folder)
    assert printed["live"]["restarts"] == 1
    assert [cause for cause, _ in live.events(shard, "forecast")][:2] == [DIED, RESTARTED]
    points = np.array([message["t_ns"] for message in forecasts(messages)])
    assert ((points - points[0]) % PERIOD_NS == 0).all() and (np.diff(points) > 0).all()
    assert whole(shard, "skin") and whole(shard, "wrench")


def test_a_subscriber_that_never_reads_keeps_no_message_from_the_others(lab: Lab) -> None:
    from websockets.sync.client import connect

    with socket.create_server(("127.0.0.1", 0)) as free:
        place = free.getsockname()[1]
    received: list[dict[str, Any]] = []
    with live.served(lab.folder, SKIN), subscriber() as (port, messages):
        process = started(lab, f"-o rec --json --publish ws:127.0.0.1:{place} --publish udp:127.0.0.1:{port}")
        await_from(process, lambda: bool(forecasts(messages)))
        with socket.socket() as slow, connect(f"ws://127.0.0.1:{place}/?max_age_ms=600000", max_size=None) as quick:
            slow.connect(("127.0.0.1", place))
            slow.sendall(HANDSHAKE)

            def listen() -> None:
                while len(received) < 200:
                    received.append(json.loads(quick.recv(600)))

            listening = threading.Thread(target=listen, daemon=True)
            listening.start()
            await_from(process, lambda: len(received) == 200)
            ended(process, interrupt=True)
            listening.join()
    assert received[0]["kind"] == "description"
    missed = np.array([message["missed"] for message in received[1:]])
    assert (
        np.diff([message["seq"] for message in received[1:]]) == 1 + np.diff(missed)
    ).all()  # none on a quick computer
    assert (np.diff([message["seq"] for message in messages if message["kind"] == "forecast"]) == 1).all()
    shard = live.only(lab.folder)
    assert whole(shard, "skin")
    recorded = shard.table("forecast").column("t_device_ns").to_pylist()
    assert len(recorded) > 100  # the last ones left when the recording was over
    assert recorded == [message["t_ns"] for message in forecasts(messages)][: len(recorded)]
