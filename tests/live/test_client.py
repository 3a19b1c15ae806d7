"""Test that the programs on the page about controllers work as described."""

import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tacpipe.live.websocket import WebsocketPublisher
from tacpipe.sensors.live import OFF, ON, UNKNOWN
from tacpipe.tasks.slip.live.messages import SlipDescription, SlipMessage
from tests.live.test_publishers import free_port
from tests.live.test_subscription import slip
from tests.recording.live import ROOT, awaited

FOLDER = ROOT / "docs" / "howto"
ABOUT = SlipDescription("model", 50.0, 0.3, "1", {})


def program(title: str) -> str:
    """Return a program that the page prints."""
    text = (FOLDER / "control.md").read_text()
    (block,) = re.findall(rf'```\w+ title="{re.escape(title)}"\n(.*?)^```$', text, re.DOTALL | re.MULTILINE)
    return str(block)


@contextlib.contextmanager
def running(folder: Path, *words: str) -> Iterator[list[str]]:
    """Run a program, and yield the lines that it has printed so far."""
    lines: list[str] = []
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(words, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        reading = threading.Thread(target=lambda: lines.extend(process.stdout or []))
        reading.start()
        try:
            yield lines
        finally:
            process.kill()
            reading.join()


def states(lines: list[str]) -> list[str]:
    """Return the states that a client printed; a busy computer can add unknown ones between them."""
    return [state for line in lines if (state := line.split("slip: ")[1].split()[0]) != "unknown"]


def published_until(publisher: WebsocketPublisher, message: SlipMessage, lines: list[str], text: str) -> None:
    """Publish a message repeatedly, made from new samples, until a client has printed a text after the lines so far."""
    count = len(lines)

    def is_printed() -> bool:
        now_ns = time.monotonic_ns() + message.offset_ns
        publisher.publish(replace(message, t_ns=now_ns, made_from_t_ns=now_ns))
        return any(text in line for line in lines[count:])

    awaited(is_printed)


def test_the_python_client_prints_each_change_and_unknown_without_a_session(tmp_path: Path) -> None:
    (tmp_path / "client.py").write_text(program("client.py"))
    port = free_port()
    with running(tmp_path, sys.executable, "client.py", f"ws://127.0.0.1:{port}") as lines:
        awaited(lambda: any("unknown the session is not connected" in line for line in lines))
        publisher = WebsocketPublisher(f"127.0.0.1:{port}", ABOUT)
        for state, printed in ((OFF, "slip: off"), (ON, "slip: on")):
            published_until(publisher, SlipMessage(1, 1, 0.5, 0.0, state), lines, printed)
        silent = SlipMessage(2, 1, alarm_state=UNKNOWN, cause="nothing new comes from left")
        published_until(publisher, silent, lines, "slip: unknown")
        published_until(publisher, SlipMessage(3, 1, 0.5, 0.0, ON), lines, "slip: on")
        awaited(lambda: "unknown no message came within 100 ms" in lines[-1])
        publisher.close()
    assert states(lines)[:2] == ["off", "on"] and states(lines)[-1] == "on"


@pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is missing")
def test_the_cpp_client_follows_two_sessions_and_ends_with_the_first_alarm(tmp_path: Path) -> None:
    (tmp_path / "client.cpp").write_text(program("client.cpp"))
    warnings = ("-Wall", "-Wextra", "-Wconversion", "-Wpedantic", "-Werror")
    compiler = ("g++", "-std=c++17", *warnings, "-fsanitize=address,undefined", f"-I{FOLDER}")
    subprocess.run([*compiler, "client.cpp", "-o", "client"], cwd=tmp_path, check=True)
    port = free_port()
    with running(tmp_path, "./client", str(port)) as lines:
        awaited(lambda: lines == ["slip: unknown\n"])
        for _ in range(2):
            publisher = WebsocketPublisher(f"127.0.0.1:{port}", ABOUT)
            published_until(publisher, SlipMessage(1, 1, 0.5, 0.0, OFF, {"left": [0.5] * 20_000}), lines, "slip: off")
            publisher.close()
            awaited(lambda: lines[-1] == "slip: unknown\n")
        publisher = WebsocketPublisher(f"127.0.0.1:{port}", ABOUT)
        old = slip(1, age_ms=60_000)
        old.alarm_state = ON
        for _ in range(10):
            publisher.publish(old)
        published_until(publisher, slip(2), lines, "slip: off")  # a young message without an alarm
        published_until(publisher, SlipMessage(3, 1, 0.5, 0.0, ON), lines, "slip: on")
        publisher.close()
    assert states(lines)[-1] == "on" and set(states(lines)[:-1]) == {"off"}


def test_the_program_for_ros_advertises_and_publishes_as_the_protocol_of_rosbridge_says(tmp_path: Path) -> None:
    from websockets.sync.server import serve

    (tmp_path / "to_ros.py").write_text(program("to_ros.py"))
    received: list[dict[str, Any]] = []
    port = free_port()
    publisher = WebsocketPublisher(f"127.0.0.1:{port}", ABOUT)

    def is_received() -> bool:
        publisher.publish(slip(7))
        return any("alarm" in content["msg"]["data"] for content in received[1:])

    with serve(lambda client: received.extend(map(json.loads, client)), "127.0.0.1", 0) as rosbridge:
        serving = threading.Thread(target=rosbridge.serve_forever)
        serving.start()
        addresses = (f"ws://127.0.0.1:{port}", f"ws://127.0.0.1:{rosbridge.socket.getsockname()[1]}")
        with running(tmp_path, sys.executable, "to_ros.py", *addresses):
            awaited(is_received)
        rosbridge.shutdown()
        serving.join()
    publisher.close()
    topic = {"topic": "/tacpipe/live"}
    assert received[0] == {"op": "advertise", **topic, "type": "std_msgs/msg/String"}
    assert all({**content, "msg": 0} == {"op": "publish", **topic, "msg": 0} for content in received[1:])
    messages = [json.loads(content["msg"]["data"]) for content in received[1:]]
    assert next(message for message in messages if message["kind"] == "slip")["seq"] == 7
