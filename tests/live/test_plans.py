"""Plans reach a session by UDP, by websocket and from the arm's own set-points; where they end, that is the cause."""

import contextlib
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import tacpipe
from tacpipe.live.preparation import free_ports
from tacpipe.sensors import plan as plans
from tests.conftest import Lab
from tests.live.sessions import TRAINED, commanded, ended, forecasts, subscriber, whole
from tests.recording import live

pytestmark = [pytest.mark.rig, pytest.mark.long]
SKINS = tuple(live.stream(f"xela{n}", "xela", "ws:127.0.0.1:5000", f"{{ sensor = {n}, rate_hz = 50 }}") for n in (1, 2))
ARM = live.stream("robot", "franka", "tcp+udp:172.16.0.2:1337", "{ targets = true }")
ENDED, NONE = "the plan has ended", "there is no plan"
AHEAD_NS = 300_000_000
POSE = np.array([0.5, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0])


@pytest.fixture
def trained(lab: Lab) -> Lab:
    for command in TRAINED:
        lab.run(command)
    return lab


def started(lab: Lab, options: str) -> subprocess.Popen[str]:
    """Return ``tacpipe live`` with the model, running in a process of its own."""
    return commanded(lab, f"live rig.toml --model models/f -o rec --json {options}")


def packet() -> bytes:
    """Return a plan that begins now: the hand stays."""
    t_ns = time.time_ns() + np.linspace(0, AHEAD_NS, 4).astype(np.int64)
    return plans.packet(t_ns.tolist(), np.tile(POSE, (4, 1)))


@contextlib.contextmanager
def planner(scheme: str) -> Iterator[tuple[str, threading.Event]]:
    """Send plans all the time, until an event; yield the address as ``--plan`` takes it, and the event."""
    over = threading.Event()
    (port,) = free_ports(1)
    if scheme == "udp":
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sending:

            def send() -> None:
                while not over.wait(0.05):
                    sending.sendto(packet(), ("127.0.0.1", port))

            thread = threading.Thread(target=send)
            thread.start()
            try:
                yield f"udp:127.0.0.1:{port}", over
            finally:
                over.set()
                thread.join()
        return
    from websockets.sync.server import serve

    is_over = threading.Event()

    def answer(connection: Any) -> None:
        with contextlib.suppress(Exception):  # the session ends
            while not over.wait(0.05):
                connection.send(packet().decode())
            is_over.wait()

    with serve(answer, "127.0.0.1", 0) as server:
        port = server.socket.getsockname()[1]
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"ws:127.0.0.1:{port}", over
        finally:
            over.set()
            is_over.set()
            server.shutdown()
            thread.join()


def awaited(messages: list[dict[str, Any]], process: subprocess.Popen[str], cause: str, count: int = 10) -> None:
    """Wait until so many forecasts more have a cause that begins so; an empty one: none."""
    first = len(messages)

    def there() -> bool:
        assert process.poll() is None, process.communicate()[1]
        causes = [message["cause"] for message in forecasts(messages[first:])]
        return (
            len(
                [
                    message_cause
                    for message_cause in causes
                    if (message_cause.startswith(cause) if cause else not message_cause)
                ]
            )
            >= count
        )

    live.awaited(there)


@pytest.mark.parametrize("scheme", ["udp", "ws"])
def test_a_plan_that_ends_is_the_cause_from_then_on_and_forecasts_continue(trained: Lab, scheme: str) -> None:
    with (
        live.served(trained.folder, *SKINS, ARM),
        subscriber() as (port, messages),
        planner(scheme) as (address, over),
    ):
        process = started(trained, f"--plan {address} --publish udp:127.0.0.1:{port}")
        awaited(messages, process, "")
        over.set()
        awaited(messages, process, ENDED)
        ended(process, interrupt=True)
    shard = live.only(trained.folder)
    rows = shard.table("plan")
    assert rows.num_rows % 4 == 0 and rows["position_x_m"].to_pylist()[0] == 0.5
    assert all(whole(shard, name) for name in ("xela1", "xela2"))


def test_set_points_of_the_arm_are_the_plan_and_predict_gives_the_same_from_the_recording(trained: Lab) -> None:
    with live.served(trained.folder, *SKINS, ARM), subscriber() as (port, messages):
        process = started(trained, f"--plan rig:robot --publish udp:127.0.0.1:{port}")
        awaited(messages, process, "", 60)
        printed = ended(process, interrupt=True)
    trained.run("predict models/f rec -o predicted --causal --steps 1,2")
    (predicted,) = tacpipe.open("predicted")
    table = predicted.table()
    row_by_time = dict(zip(table["t_ns"].to_pylist(), range(table.num_rows), strict=True))
    names = [name for name in table.column_names if name != "t_ns"]
    values = np.column_stack([table[name].to_numpy() for name in names])
    shard = live.only(trained.folder)
    recorded = shard.table("forecast")
    published = np.column_stack([recorded[name].to_numpy() for name in names])
    rows = [row_by_time[t_ns] for t_ns in recorded["t_device_ns"].to_pylist()]
    differ = (values[rows] != published).any(axis=1).sum()
    assert len(rows) >= 60 and differ <= 4 * printed["live"]["late"]  # each is read by context rows, and the next point
    assert shard.attributes["live_plan"] == "rig:robot"


def test_a_rig_without_a_stream_that_the_model_needs_or_with_another_layout_ends_with_2_and_a_sentence(
    trained: Lab,
) -> None:
    other_sensor = live.stream("xela2", "optoforce", "serial:/dev/ttyS9", "{ rate_hz = 333 }")
    for streams, missing in (((SKINS[0], ARM), "xela2"), ((SKINS[0], other_sensor, ARM), "xela2"), (SKINS, "robot")):
        (trained.folder / "rig.toml").write_text("".join(streams))
        process = started(trained, "--duration-s 1")
        _, err = process.communicate()
        assert process.returncode == 2 and missing in err and "Traceback" not in err
        assert not (trained.folder / "rec").exists()
