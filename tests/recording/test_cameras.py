"""Test that images of HTTP cameras are recorded bit for bit, whatever happens to the link or the recorder."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from tacpipe.recording.station import LOST, OPENED
from tacpipe.video.frames import read_frames
from tacpipe.video.stream import read_format
from tests.conftest import Lab
from tests.emulation.byte_faults import Faults
from tests.emulation.emulator import Emulator
from tests.recording import live
from tests.recording.test_unplugging import end_recording, enough, plug
from tests.video import videos

CAMERA = "mjpeg:http://127.0.0.1:8080/stream"
GEL = live.stream("gel1", "camera", CAMERA, "{ rate_hz = 25 }")


@pytest.fixture
def rig(lab: Lab) -> Iterator[Emulator]:
    with live.served(lab.folder, GEL, live.RANGE) as emulator:
        yield emulator


def frames(shard: Any, name: str = "gel1") -> list[tuple[int, bytes]]:
    """Return the server's stamp and the packet of each recorded frame."""
    table = shard.table(name)
    return list(zip(table.column("t_device_ns").to_pylist(), table.column("packet").to_pylist(), strict=True))


def sent_frames(rig: Emulator, name: str = "gel1") -> list[tuple[int, bytes]]:
    """Return the server's stamp and the image of each frame that was sent whole."""
    samples = rig.ledger[name].samples()
    assert samples.t_device_ns is not None
    return list(zip(samples.t_device_ns.tolist(), samples.values[0][:, 0].tolist(), strict=True))


def is_block(part: list[tuple[int, bytes]], full: list[tuple[int, bytes]]) -> bool:
    """Return whether the recorded frames are those that were sent, one after another."""
    start = full.index(part[0])
    return full[start : start + len(part)] == part


def start_recording(lab: Lab, rig: Emulator) -> subprocess.Popen[str]:
    process = live.started(lab.folder, "--name trial")
    live.awaited(lambda: live.spools(lab.folder))
    enough(rig, "gel1", 15)
    return process


def test_frames_are_recorded_bit_for_bit_with_the_stamps_of_server_and_host(lab: Lab, rig: Emulator) -> None:
    end_recording(start_recording(lab, rig))
    shard = live.only(lab.folder)
    columns = shard.columns("gel1")
    video_format = read_format(columns)

    assert video_format is not None
    assert (video_format.codec, video_format.width_px, video_format.height_px) == ("mjpeg", 320, 240)
    assert video_format.nominal_rate_hz == Fraction(25)
    assert len(frames(shard)) >= 15
    assert is_block(frames(shard), sent_frames(rig))
    assert shard.attributes["gel1_lost"] == 0
    stamps = columns.read(["t_ns", "pts"])
    assert (np.diff(stamps.column("t_ns").to_numpy()) > 0).all()
    assert (np.diff(stamps.column("pts").to_numpy()) > 0).all()
    assert read_frames(columns, [3])[3].shape == (240, 320, 3)
    (text,) = (lab.folder / "rec").glob("rig-*.toml")
    assert 'pixel_format = "yuvj422p"' in text.read_text()


def test_a_server_that_goes_away_is_lost_and_opened_again(lab: Lab, rig: Emulator) -> None:
    process = start_recording(lab, rig)
    plug(rig, "gel1", back=False)
    enough(rig, "range", 60)
    plug(rig, "gel1", back=True)
    enough(rig, "gel1", 15)
    end_recording(process)
    shard = live.only(lab.folder)

    causes = [cause for cause, _ in live.events(shard, "gel1")]
    assert [cause for cause in causes if cause in (LOST, OPENED)] == [LOST, OPENED]
    sent = iter(sent_frames(rig))
    assert all(any(frame == sent_frame for sent_frame in sent) for frame in frames(shard))
    assert shard.attributes["gel1_lost_estimated"] > 0


def test_what_a_killed_recorder_wrote_is_recovered_bit_for_bit(lab: Lab, rig: Emulator) -> None:
    process = start_recording(lab, rig)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    words = [sys.executable, "-m", "tests.recording.patient", "acquire", "--recover", "-o", "rec", "--json"]
    environment = {**os.environ, "PYTHONPATH": str(live.ROOT)}
    recover = subprocess.run(words, cwd=lab.folder, env=environment, capture_output=True, check=True)
    (recording,) = json.loads(recover.stdout)["recordings"]
    shard = live.only(lab.folder)

    assert recording["ended"] == "recovered"
    assert is_block(frames(shard), sent_frames(rig))


def test_harmed_frames_are_losses_and_none_is_made_up(lab: Lab) -> None:
    faults = Faults(cut=2.0, noise=2.0, drop=0.05)
    with live.served(lab.folder, GEL, live.RANGE, faults=faults) as rig:
        process = start_recording(lab, rig)
        enough(rig, "gel1", 40)
        end_recording(process)
        harmed = set(rig.ledger["gel1"].harmed.values())
        sent = sent_frames(rig)
    shard = live.only(lab.folder)
    recorded = frames(shard)

    assert harmed
    assert set(recorded) <= set(sent)
    causes = {cause for cause, _ in live.events(shard, "gel1")}
    assert causes & {"malformed", LOST}


def test_a_video_file_is_served_frame_for_frame(lab: Lab) -> None:
    path = videos.write(lab.folder / "gel.avi", "mjpeg", 40)
    served = GEL.replace("[[stream]]", "[[stream]]\nemulate = { video = '" + str(path) + "' }")
    with live.served(lab.folder, served, live.RANGE) as rig:
        process = start_recording(lab, rig)
        end_recording(process)
    packets = [packet for _, packet in frames(live.only(lab.folder))]
    originals = videos.packets(path)
    first = originals.index(packets[0])
    assert packets == [originals[(first + row) % len(originals)] for row in range(len(packets))]
