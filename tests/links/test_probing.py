"""Test that a port is probed first by listening at likely rates, and then by the requests of drivers."""

import json
import os
import pty
import select
import socket
import termios
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from tacpipe.links import probing
from tacpipe.links.link import parse
from tacpipe.links.probing import candidates
from tacpipe.recording import rig
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Samples, Sensor
from tests.conftest import Lab
from tests.emulation.devices import device_for

RNG = np.random.default_rng(7)


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, seconds in {"BOOT_S": 0.3, "FIRST_S": 0.3, "LISTEN_S": 0.3, "REPLY_S": 0.1}.items():
        monkeypatch.setattr(probing, name, seconds)


def flexitac() -> tuple[Sensor, list[bytes]]:
    sensor = rig.build_sensor("flexitac", {"rows": 16, "columns": 16, "baud": 2_000_000}, "test")
    return sensor, [bytes(frame) for frame in sensor.encode(Samples((RNG.integers(0, 40, (200, 256), np.uint8),)))]


def optoforce() -> tuple[Sensor, list[bytes]]:
    sensor = rig.build_sensor("optoforce", {"axes": 3}, "test")
    counts = RNG.integers(-900, 900, (200, 3), np.int16)
    samples = Samples((np.zeros((200, 1), np.uint16), counts), seq=np.arange(200))
    return sensor, [bytes(frame) for frame in sensor.encode(samples)]


@contextmanager
def play(sensor: Sensor, frames: list[bytes]) -> Iterator[tuple[str, list[bytes]]]:
    """A device on a pseudo-terminal, which sends rubbish while its rate of baud is not that of the port."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    over = threading.Event()
    port_speed = getattr(termios, f"B{sensor.baud}")
    heard: list[bytes] = []

    def run() -> None:
        device, number = device_for(sensor), 0
        while not over.wait(0.002):
            while select.select([master], [], [], 0)[0]:
                heard.append(os.read(master, 1000))
                for reply in device.hear(heard[-1]):
                    os.write(master, reply)
            if device.streaming and select.select([], [master], [], 0)[1]:
                right = termios.tcgetattr(master)[4] == port_speed
                frame = frames[number % len(frames)]
                os.write(master, frame if right else bytes(len(frame) // 2))
                number += 1

    thread = threading.Thread(target=run)
    thread.start()
    yield os.ttyname(slave), heard
    over.set()
    thread.join()
    os.close(slave)
    os.close(master)


@pytest.mark.rig
def test_a_device_that_streams_is_found_at_its_rate_of_baud_without_a_word_to_it() -> None:
    steps: list[str] = []
    with play(*flexitac()) as (path, heard):
        report = probing.probe(parse(f"serial:{path}"), progress=steps.append)

    first = report.findings[0]
    assert (first.name, dict(first.candidate.options)) == ("flexitac", {"rows": 16, "columns": 16})
    assert (report.baud, report.requested, report.certain) == (2_000_000, False, True)
    assert heard == []
    assert len(steps) >= 2 and all("listening at" in step for step in steps)


@pytest.mark.rig
def test_a_silent_device_is_asked_as_its_driver_does_and_told_to_stop() -> None:
    with play(*optoforce()) as (path, heard):
        report = probing.probe(parse(f"serial:{path}"))
        time.sleep(0.05)

    first = report.findings[0]
    assert (first.name, dict(first.candidate.options), report.requested) == ("optoforce", {"axes": 3}, True)
    assert b"".join(heard).endswith(bytes.fromhex("aa 00 32 03 00 04 00 00 e3"))  # speed 0: stop


@pytest.mark.rig
def test_nothing_is_written_to_a_device_that_is_only_listened_to() -> None:
    with play(*optoforce()) as (path, heard):
        report = probing.probe(parse(f"serial:{path}"), passive=True)

    assert report.findings == [] and not report.certain
    assert heard == []


def test_the_bauds_of_drivers_that_know_the_device_come_first() -> None:
    bauds = probing._bauds("16d0:14cc")  # a Robotiq, at 115,200 as most
    assert bauds[0] == 115_200
    assert len(bauds) == len(set(bauds)) >= 5
    assert probing._sort_by_usb_id(candidates(Chunks.from_pairs([]), "serial"), "16d0:14cc")[0].kind == "robotiq"


def test_a_port_that_cannot_be_opened_is_reported_with_its_reason() -> None:
    report = probing.probe(parse("serial:/dev/ttyNOWHERE"))

    assert "there is no port /dev/ttyNOWHERE" in report.error
    assert not report.certain


@pytest.mark.rig
def test_the_command_prints_what_speaks_and_the_lines_for_the_rig_file(lab: Lab) -> None:
    with play(*flexitac()) as (path, _):
        output = lab.run(f"sensors probe {path}").out
        listed = json.loads(lab.run(f"sensors probe serial:{path} --json").out)

    lines = [line.strip() for line in output.splitlines()]
    assert lines[0].startswith(f"serial:{path} speaks flexitac (rows = 16, columns = 16): ")
    assert lines[0].endswith("at 2,000,000 baud.")
    parsed = rig.parse("\n".join(lines[lines.index("[[stream]]") :]))
    assert parsed.streams["flexitac"].sensor == rig.build_sensor("flexitac", {"rows": 16, "columns": 16}, "test")
    assert listed["ports"][0]["findings"][0]["sensor"] == "flexitac"
    assert listed["ports"][0]["certain"] is True


def test_the_command_exits_with_5_where_nothing_is_recognised(lab: Lab) -> None:
    ran = lab.call("sensors probe serial:/dev/ttyNOWHERE")

    assert ran.code == 5
    assert "there is no port /dev/ttyNOWHERE" in ran.out


@pytest.mark.rig
def test_datagrams_are_recognised_too(lab: Lab) -> None:
    sensor = rig.build_sensor("ati-netft", {}, "test")
    frames = sensor.encode(_force_samples(sensor))
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out,
    ):
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
        free.close()
        over = threading.Event()

        def run() -> None:
            for frame in (bytes(frame) for frame in frames):
                if over.wait(0.005):
                    return
                out.sendto(frame, ("127.0.0.1", port))

        thread = threading.Thread(target=run)
        thread.start()
        report = probing.probe(parse(f"udp::{port}"), passive=True)
        over.set()
        thread.join()

    assert report.findings[0].name == "ati-netft"


def _force_samples(sensor: Sensor) -> Samples:
    """Return samples of a force sensor behind a network box."""
    counts = RNG.integers(-(10**6), 10**6, (400, 6), np.int32)
    return Samples((np.zeros((400, 1), np.uint32), counts), seq=np.arange(400), device_seq=np.arange(400))


def test_the_list_names_every_sensor_with_what_it_is(lab: Lab) -> None:
    lines = lab.run("sensors list").out.splitlines()
    rows = {row["name"]: row for row in json.loads(lab.run("sensors list --json").out)["sensors"]}

    assert [line.split()[0] for line in lines] == ["sensor", *sorted(rows)]
    assert rows["optoforce"] == {
        "name": "optoforce",
        "links": ["serial"],
        "rate_hz": 1000.0,
        "baud": 1_000_000,
        "summary": "OptoForce 3-axis, 6-axis and 4 x 3-axis force sensors behind their USB DAQ.",
        "exclusive": "",
    }
    assert "one program" in rows["ati-netft"]["exclusive"]
    assert rows["xela"]["links"] == ["ws"] and rows["xela"]["baud"] is None
    assert all(row["summary"].endswith(".") for row in rows.values())
