"""Test that samples, timestamps and description of an LSL stream of another process arrive."""

import math
import os
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.channels import lsl as descriptions
from tacpipe.errors import DeviceError, TacpipeError, UsageError
from tacpipe.links.link import Link, LinkLostError, parse
from tacpipe.links.opening import open_link
from tacpipe.links.probing import recognise
from tacpipe.recording import recorder, rig
from tacpipe.recording.reading import LinkReader
from tacpipe.recording.spool import StreamNote
from tacpipe.recording.station import Station
from tacpipe.sensors import lsl
from tacpipe.sensors.framing import Chunks

SOON_S = 120.0  # The longest wait for anything; only a failure waits so long
OUTLET = Path(__file__).with_name("lsl_outlet.py")
CONFIG = (
    "[log]\nlevel = -3\n[lab]\nKnownPeers = {{127.0.0.1}}\nSessionID = {session}\n[multicast]\nResolveScope = machine\n"
)
FORCE = {
    "channels": [{"name": f"f{axis}", "unit": "N", "quantity": "force", "component": axis} for axis in "xyz"],
    "format": "float32",
    "rate_hz": 200.0,
}


@pytest.fixture(scope="session", autouse=True)
def _isolated(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep these streams within this computer, and apart from those of other tests: liblsl reads this once a process."""
    path = tmp_path_factory.mktemp("lsl") / "lsl_api.cfg"
    path.write_text(CONFIG.format(session=uuid.uuid4()))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LSLAPICFG", str(path))
        yield


@contextmanager
def outlet(kind: str, name: str, first: int = 0) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, str(OUTLET), kind, name, str(first)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=os.environ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "up\n"
        try:
            yield process
        finally:
            process.kill()


def stop_outlet(process: subprocess.Popen[str]) -> int:
    """Have an outlet end, and return how many samples it sent."""
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write("\n")
    process.stdin.close()
    return int(process.stdout.readline())


def build_lsl(options: Mapping[str, Any] | None = None) -> lsl.Lsl:
    sensor = rig.build_sensor("lsl", options or {}, "test")
    assert isinstance(sensor, lsl.Lsl)
    return sensor


def opened(place: str, options: Mapping[str, Any] | None = None) -> Link:
    return open_link(parse(f"lsl:{place}"), build_lsl(options), "wrist")


def read_until(link: Link, until: Any) -> list[tuple[int, bytes]]:
    """Read until ``until`` says so of all that came."""
    packets: list[tuple[int, bytes]] = []
    stop = time.monotonic() + SOON_S
    while not until(packets) and time.monotonic() < stop:
        packets += link.read(0.1)
    return packets


def unique() -> str:
    return f"wrist-{uuid.uuid4().hex[:8]}"


@pytest.mark.rig
def test_every_sample_that_was_sent_comes_with_its_stamp_and_the_correction_of_lsl() -> None:
    name = unique()
    with outlet("force", name) as process:
        began_ns = time.monotonic_ns()
        with closing(opened(name, FORCE)) as link:
            packets = read_until(link, lambda received: _correct(received) and len(received) > 100)
            sent = stop_outlet(process)
            with pytest.raises(LinkLostError, match="wrist"):
                while True:
                    packets += link.read(0.1)
    samples = LinkReader(build_lsl(FORCE)).feed(Chunks.from_pairs(packets))
    forces, corrections = samples.values
    assert forces.tolist() == [[row, 2 * row, 3 * row] for row in range(sent)]
    assert samples.t_device_ns is not None and (np.diff(samples.t_device_ns) > 0).all()
    # LSL's clock is the monotonic one on this computer, so the correction is nearly zero.
    assert began_ns < samples.t_device_ns[0] and (samples.t_device_ns <= samples.t_ns).all()
    finite = corrections[np.isfinite(corrections)]
    assert len(finite) and np.abs(finite).max() < 0.05


def _correct(packets: list[tuple[int, bytes]]) -> bool:
    heads = [lsl.HEAD.unpack_from(data) for _, data in packets if data[:1] == lsl.NUMBERS]
    return any(math.isfinite(correction) for _, correction, _ in heads)


@pytest.mark.rig
def test_markers_are_events_as_text() -> None:
    name = unique()
    with outlet("markers", name), closing(opened(f"?type=Markers&name={name}")) as link:
        packets = read_until(link, lambda received: len(received) > 5)
    (options,) = lsl.guess_options(Chunks.from_pairs(packets))
    sensor = build_lsl(options)
    (texts, _) = LinkReader(sensor).feed(Chunks.from_pairs(packets)).values
    assert texts[:, 0].tolist() == [f"trial {row} ✓" for row in range(len(texts))] and len(texts)
    assert next((field.name, field.type) for field in sensor.fields()) == ("event", pa.string())


@pytest.mark.rig
def test_a_rig_without_channels_takes_those_that_the_outlet_describes() -> None:
    name = unique()
    text = f'[[stream]]\nname = "wrist"\nsensor = "lsl"\ntransport = "lsl:?source_id={name}-1"\n'
    with outlet("force", name):
        completed = recorder.complete_rig(rig.parse(text))
    assert completed.streams["wrist"].sensor == build_lsl(FORCE)
    assert rig.parse(completed.text).streams["wrist"].sensor == build_lsl(FORCE)


@pytest.mark.rig
def test_an_outlet_that_ended_is_opened_anew_when_it_is_back() -> None:
    name = unique()
    text = f'[[stream]]\nname = "wrist"\nsensor = "lsl"\ntransport = "lsl:{name}"\n'
    with outlet("force", name) as process:
        station = Station(recorder.complete_rig(rig.parse(text)).streams["wrist"])
        station.start()
        blocks: list[Any] = []
        _collect_until(station, blocks, lambda: _samples(blocks) > 20)
        stop_outlet(process)
    _collect_until(
        station, blocks, lambda: any(isinstance(block, StreamNote) and block.what == "lost" for block in blocks)
    )
    with outlet("force", name, first=1_000_000):
        _collect_until(station, blocks, lambda: any(_values(blocks) >= 1_000_000))
    station.stop()
    assert [block.what for block in blocks if isinstance(block, StreamNote) and block.what in ("opened", "lost")][
        :3
    ] == [
        "opened",
        "lost",
        "opened",
    ]
    steps = np.diff(_values(blocks))
    assert (steps == 1).sum() == len(steps) - 1  # all that was sent while a link was open, and one step between the two


def _collect_until(station: Station, blocks: list[Any], until: Any) -> None:
    stop = time.monotonic() + SOON_S
    while not until() and time.monotonic() < stop:
        blocks += station.take()
        time.sleep(0.02)
    assert until()


def _values(blocks: list[Any]) -> Any:
    chunks = Chunks.concatenate([block for block in blocks if isinstance(block, Chunks)])
    return (
        build_lsl(FORCE).decode(build_lsl(FORCE).framer().feed(chunks)[0][0].frames).values[0][:, 0]
        if len(chunks.size) > 1
        else np.zeros(0)
    )


def _samples(blocks: list[Any]) -> int:
    return len(_values(blocks))


@pytest.mark.rig
def test_a_stream_that_is_not_as_the_rig_file_states_is_refused_with_both() -> None:
    name = unique()
    with outlet("counts", name), pytest.raises(DeviceError, match=r"2 channels of int32.*3 of float32"):
        opened(name, FORCE)


@pytest.mark.rig
def test_an_outlet_that_is_not_there_and_one_that_is_there_twice_are_named() -> None:
    name = unique()
    with outlet("force", name), outlet("counts", name):
        with pytest.raises(DeviceError, match=r"2 outlets"):
            opened(name)
        with pytest.raises(DeviceError, match=name):  # The message lists the existing outlets
            opened("nothing")


@pytest.mark.parametrize("place", ["?", "?colour=red", "?type=", "a'b", "?name=a'or'b"])
def test_an_address_that_names_no_stream_is_refused(place: str) -> None:
    with pytest.raises(UsageError, match="source_id"):
        opened(place)


def test_a_description_among_packets_is_recognised_with_its_options() -> None:
    text = (
        "<info><name>w</name><type>Force</type><channel_count>3</channel_count><channel_format>float32</channel_format><nominal_srate>200</nominal_srate><desc><channels>"
        + "".join(f"<channel><label>F{axis}</label><unit>newtons</unit></channel>" for axis in "xyz")
        + "</channels></desc></info>"
    )
    packets = [
        lsl.pack_samples(np.full((1, 3), row, dtype=np.float32), np.array([row / 200]), math.nan) for row in range(50)
    ]
    data = Chunks.from_pairs(
        [(0, lsl.DESCRIPTION + text.encode()), *((row * 5_000_000, packet) for row, packet in enumerate(packets))]
    )
    (finding,) = recognise(data, "lsl")
    assert (finding.name, dict(finding.candidate.options)) == ("lsl", FORCE)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("float32", "float33"), "float33"),
        ((">3<", ">three<"), "three"),
        ((">3<", ">0<"), "0"),
        ((">200<", ">-1<"), "-1"),
        (("</info>", ""), "XML"),
    ],
)
def test_a_description_that_is_none_is_refused_with_what_is_wrong(change: tuple[str, str], message: str) -> None:
    entries = {"channel_count": "3", "channel_format": "float32", "nominal_srate": "200"}
    text = "<info>" + "".join(f"<{key}>{value}</{key}>" for key, value in entries.items()) + "</info>"
    assert [channel.name for channel in descriptions.parse(text).channels] == ["value01", "value02", "value03"]
    with pytest.raises(TacpipeError, match=message):
        descriptions.parse(text.replace(*change))
