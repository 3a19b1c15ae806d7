"""A host reads over each kind of link the samples that the ledger lists as sent."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacpipe.errors import DeviceError, UsageError
from tacpipe.links import opening
from tacpipe.links.link import Link, LinkLostError
from tacpipe.links.opening import open_link
from tacpipe.recording import rig
from tacpipe.recording.rig import Rig
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Samples, Sensor
from tests.emulation.byte_faults import Faults
from tests.emulation.emulator import Emulator
from tests.emulation.ledger import Ledger, concatenate
from tests.emulation.rigs import ALL_SENSORS, FIRST_PAPER, PATIENCE_S, awaited, in_order, one_stream_rig

pytestmark = pytest.mark.rig

FRAMES = 60


class Reader:
    """A host: opens a link, holds the sensor's dialogue, reads and frames."""

    def __init__(self, emulator: Emulator, name: str = "load") -> None:
        stream = emulator.rig.streams[name]
        self.sensor: Sensor = stream.sensor
        self.link: Link = open_link(stream.address, self.sensor, name)
        self.framer = self.sensor.framer()
        self.runs: list[Any] = []
        self.losses: list[Any] = []
        self.take(opening.run_dialogue(self.link, self.sensor.opening(self.link.local), name))

    def take(self, chunks: list[tuple[int, bytes]]) -> None:
        for _, chunk in chunks:
            if answer := self.sensor.answer(chunk):
                self.link.write(answer)
        runs, losses = self.framer.feed(Chunks.from_pairs(chunks))
        self.runs, self.losses = self.runs + runs, self.losses + losses

    def read(self, frames: int = FRAMES) -> Samples:
        """Return the samples of at least so many frames."""
        until = time.monotonic() + PATIENCE_S
        while sum(len(run.frames) for run in self.runs) < frames:
            assert time.monotonic() < until, "the frames did not come"
            if self.sensor.request():
                self.link.write(self.sensor.request())
            self.take(self.link.read(0.2))
        return concatenate(
            [self.sensor.decode(run.frames) for run in self.runs], [len(run.frames) for run in self.runs]
        )


@contextmanager
def reading(emulator: Emulator, name: str = "load") -> Iterator[Reader]:
    reader = Reader(emulator, name)
    try:
        yield reader
    finally:
        if closing := reader.sensor.closing():
            reader.link.write(closing)
        reader.link.close()


def assert_sent(received: Samples, ledger: Ledger) -> None:
    """Fail unless the received samples were sent in this order."""
    sent = ledger.samples()
    for received_block, sent_block in zip(received.values, sent.values, strict=True):
        if sent_block.dtype != object:
            assert in_order(received_block, sent_block)
    if received.seq is not None and sent.seq is not None:
        assert set(received.seq.tolist()) <= set(sent.seq.tolist())


HOST = """
import sys
from pathlib import Path
from tacpipe.links.opening import open_link
from tacpipe.recording import rig
stream = rig.read(Path(sys.argv[1])).streams["rawhid"]
link = open_link(stream.address, stream.sensor, "rawhid")
found = []
while len(found) < 50:
    found += link.read(0.5)
print(b"".join(data for _, data in found).hex())
"""
HID = ("rawhid", "spacemouse")
OVER_LINKS = [name for name in ALL_SENSORS.streams if name not in (*HID, "clouds", "tap", "camera")]


@pytest.mark.parametrize("name", OVER_LINKS)
def test_what_is_read_was_sent(name: str) -> None:
    single_rig = Rig({name: ALL_SENSORS.streams[name]}, name)
    with Emulator(single_rig) as emulator, reading(emulator, name) as reader:
        received = reader.read(FRAMES)
    assert len(received) > 0
    assert_sent(received, emulator.ledger[name])


def test_clouds_come_as_files() -> None:
    single_rig = Rig({"clouds": ALL_SENSORS.streams["clouds"]}, "clouds")
    with Emulator(single_rig) as emulator, reading(emulator, "clouds") as reader:
        received = reader.read(2)
    sent = emulator.ledger["clouds"].samples()
    assert len(received) > 2000
    first = np.flatnonzero((sent.values[0] == received.values[0][0]).all(axis=1))[0]
    assert np.array_equal(received.values[0], sent.values[0][first : first + len(received)])


def test_a_tap_listens_to_records() -> None:
    single_rig = Rig({"tap": ALL_SENSORS.streams["tap"]}, "tap")
    with Emulator(single_rig) as emulator, reading(emulator, "tap") as reader:
        received = reader.read(5)
    assert set(received.seq.tolist()) <= set(emulator.ledger["tap"].samples().seq.tolist())  # type: ignore[union-attr]


def test_the_rig_of_the_first_paper_is_served_as_a_whole() -> None:
    received = {}
    with Emulator(FIRST_PAPER) as emulator:
        for name in FIRST_PAPER.streams:
            with reading(emulator, name) as reader:
                received[name] = reader.read(20)
    for name, samples in received.items():
        assert_sent(samples, emulator.ledger[name])


def test_a_bus_within_one_process_carries_can_frames() -> None:
    requested_rig = one_stream_rig("icub-skin", "can:virtual:emulated")
    with Emulator(requested_rig) as emulator, reading(emulator) as reader:
        received = reader.read(5)
    assert_sent(received, emulator.ledger["load"])


def test_a_link_of_bytes_shows_faults_as_the_ledger_tells_them() -> None:
    faults = Faults(noise=15, cut=15, flip=15, drop=0.02)
    with Emulator(one_stream_rig("optoforce"), 1, faults) as emulator, reading(emulator) as reader:
        received = reader.read(1500)
    ledger = emulator.ledger["load"]
    assert {"noise", "cut", "flip", "drop", "sent"} <= set(ledger.counts)
    assert reader.losses
    assert_sent(received, ledger)  # The checksum has 16 bits, so no harmed frame gets through here.
    for row, data in ledger.harmed.items():
        entry = ledger.entry(row)
        assert entry.cause in ("noise", "cut", "flip")
        if entry.number >= 0:
            assert data != ledger.frames([row])[0]


def test_a_link_of_packets_shows_lost_doubled_and_swapped_ones() -> None:
    faults = Faults(drop=0.05, duplicate=0.05, reorder=0.05)
    requested_rig = one_stream_rig("ati-netft", "udp:192.168.1.1:49152", "{ rate_hz = 1000 }")
    with Emulator(requested_rig, 1, faults) as emulator, reading(emulator) as reader:
        received = reader.read(800)
    seq = received.seq
    assert seq is not None
    steps = np.diff(seq)
    assert (steps == 0).any() and (steps < 0).any() and (steps > 1).any()
    counts = emulator.ledger["load"].counts
    assert counts["drop"] > 10 and counts["duplicate"] > 10 and counts["reorder"] > 10


@pytest.mark.parametrize("name", ["optoforce", "ur_rtde", "xela", "franka"])
def test_an_unplugged_device_is_lost_and_comes_back_under_its_address(name: str) -> None:
    with Emulator(Rig({name: ALL_SENSORS.streams[name]}, name)) as emulator:
        with reading_lost(emulator, name) as reader:
            reader.read(10)
            emulator.unplug(name)
            with pytest.raises(LinkLostError):
                until_lost(reader)
        awaited(lambda: [event for event in emulator.ledger[name].events if event[1] == "unplug"])
        with pytest.raises(DeviceError):
            Reader(emulator, name)
        emulator.replug(name)
        awaited(lambda: [event for event in emulator.ledger[name].events if event[1] == "replug"])
        with reading(emulator, name) as reader:
            received = reader.read(10)
    assert_sent(received, emulator.ledger[name])


@contextmanager
def reading_lost(emulator: Emulator, name: str) -> Iterator[Reader]:
    reader = Reader(emulator, name)
    try:
        yield reader
    finally:
        reader.link.close()


def opened(emulator: Emulator) -> Reader | None:
    """Return a host, None while the device is unplugged."""
    try:
        return Reader(emulator)
    except DeviceError:
        return None


def until_lost(reader: Reader) -> None:
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        reader.take(reader.link.read(0.2))


def test_faults_unplug_by_themselves() -> None:
    with Emulator(one_stream_rig("optoforce"), 2, Faults(unplug=3, unplug_s=0.1)) as emulator:
        reader = awaited(lambda: opened(emulator))
        with pytest.raises(LinkLostError):
            until_lost(reader)
        reader.link.close()
        awaited(lambda: [event for event in emulator.ledger["load"].events if event[1] == "replug"])


def test_a_host_at_another_speed_reads_garbage() -> None:
    import serial

    with (
        Emulator(one_stream_rig("optoforce")) as emulator,
        serial.Serial(emulator.rig.streams["load"].address.target, 1_000_000) as port,
    ):
        port.write(next(emulator.rig.streams["load"].sensor.opening({})).send)
        awaited(lambda: port.in_waiting > 220)
        port.baudrate = 115_200
        port.reset_input_buffer()
        garbage = awaited(lambda: port.read(port.in_waiting) if port.in_waiting > 500 else b"")
    assert b"\xaa\x07\x08\x10" not in garbage[60:]
    assert emulator.ledger["load"].counts["baud"] > 10


def test_what_a_host_does_not_fetch_is_lost_and_told() -> None:
    import serial

    with Emulator(one_stream_rig("optoforce")) as emulator:
        ledger = emulator.ledger["load"]
        with serial.Serial(emulator.rig.streams["load"].address.target, 1_000_000) as port:
            port.write(next(emulator.rig.streams["load"].sensor.opening({})).send)
            awaited(lambda: ledger.counts.get("overrun", 0) > 50)
            received = port.read(port.in_waiting)
    frames = b"".join(ledger.frames())
    assert received[: len(received) - 22] == frames[: len(received) - 22]  # A full queue drops its newest bytes.


def test_a_device_that_is_told_another_rate_keeps_to_it() -> None:
    requested_rig = one_stream_rig("optoforce", options="{ rate_hz = 100 }")
    with Emulator(requested_rig) as emulator, reading(emulator) as reader:
        reader.read(FRAMES)
        ledger = emulator.ledger["load"]
        link: Any = reader.link
        faster = next(one_stream_rig("optoforce").streams["load"].sensor.opening({}))
        link.write(faster.send)
        awaited(lambda: len(ledger.sources) > 1)
        reader.read(4 * FRAMES)
    assert [source.timing.rate_hz for source in ledger.sources] == [100, 1000]
    assert [event[1:] for event in ledger.events if event[1] == "rate"] == [("rate", "1000")]


def test_an_arm_sends_to_the_port_that_it_was_told() -> None:
    with Emulator(one_stream_rig("franka", "tcp+udp:172.16.0.2:1337")) as emulator, reading(emulator) as reader:
        received = reader.read(200)
    ledger = emulator.ledger["load"]
    sent = ledger.samples()
    assert received.seq is not None and sent.seq is not None
    rows = np.searchsorted(sent.seq, received.seq)
    assert np.array_equal(sent.seq[rows], received.seq)
    assert np.array_equal(sent.values[0][rows], received.values[0])


def test_the_truth_of_two_runs_is_the_same() -> None:
    requested_rig = one_stream_rig("xela", "ws:127.0.0.1:5000")
    with (
        Emulator(requested_rig, 4) as first,
        Emulator(requested_rig, 4) as second,
        reading(first) as reader,
        reading(second) as second_reader,
    ):
        sent = [emulator.ledger["load"] for emulator in (first, second)]

        def shared() -> bool:
            for client in (reader, second_reader):
                client.take(client.link.read(0.1))
            common = np.intersect1d(sent[0].column("number"), sent[1].column("number"))
            return len(common) > 20

        awaited(shared)
    numbers = [ledger.column("number") for ledger in sent]
    common = np.intersect1d(numbers[0], numbers[1])
    rows = [np.flatnonzero(np.isin(sent_numbers, common)) for sent_numbers in numbers]
    first_samples, second_samples = (ledger.samples(part) for ledger, part in zip(sent, rows, strict=True))
    assert np.array_equal(first_samples.values[0], second_samples.values[0])
    assert np.array_equal(first_samples.t_device_ns, second_samples.t_device_ns)  # type: ignore[arg-type]


def test_the_rig_file_with_the_made_addresses_is_read_back() -> None:
    with Emulator(FIRST_PAPER) as emulator:
        parsed = rig.parse(rig.to_toml(emulator.rig))
        assert parsed.streams["proximity"].address == emulator.rig.streams["proximity"].address
    assert {name: stream.sensor for name, stream in parsed.streams.items()} == {
        name: stream.sensor for name, stream in FIRST_PAPER.streams.items()
    }
    assert parsed.master == FIRST_PAPER.master
    assert parsed.labels == {**FIRST_PAPER.labels, "simulated": True}


@pytest.mark.parametrize("keys", ["{ jiter_ms = 1 }", "{ finger = 3 }"])
def test_a_key_of_emulate_that_is_none_is_refused(keys: str) -> None:
    with pytest.raises(UsageError, match="emulate"), Emulator(one_stream_rig("optoforce", emulate=keys)):
        pass


def test_a_camera_cannot_be_emulated() -> None:
    with pytest.raises(DeviceError, match="cannot be emulated"), Emulator(one_stream_rig("clouds", "camera:0")):
        pass


@pytest.mark.skipif(shutil.which("umockdev-wrapper") is None, reason="umockdev is not installed")
def test_hid_boards_are_read_by_hidapi(tmp_path: Path) -> None:
    requested_rig = Rig({name: ALL_SENSORS.streams[name] for name in HID}, HID[0])
    with Emulator(requested_rig, folder=tmp_path) as emulator:
        (tmp_path / "rig.toml").write_text(rig.to_toml(emulator.rig))
        process = subprocess.run(
            ["umockdev-wrapper", sys.executable, "-c", HOST, str(tmp_path / "rig.toml")],
            env={**os.environ, "UMOCKDEV_DIR": (tmp_path / "hid" / "root").read_text().strip()},
            capture_output=True,
            text=True,
            timeout=60,
        )
    assert process.returncode == 0, process.stderr
    reports = np.frombuffer(bytes.fromhex(process.stdout.strip()), np.uint8).reshape(-1, 64)
    assert_sent(requested_rig.streams["rawhid"].sensor.decode(reports), emulator.ledger["rawhid"])
