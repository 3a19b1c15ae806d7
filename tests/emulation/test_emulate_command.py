"""The command that emulates a rig."""

import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from tacpipe.links.opening import open_link
from tacpipe.recording import rig
from tests.conftest import Lab
from tests.emulation.rigs import FOLDER, awaited

pytestmark = pytest.mark.rig


def test_simulated_trials_are_replayed_as_a_rig_until_it_is_stopped(lab: Lab) -> None:
    lab.run("simulate forward --trials 1 --duration-s 4 -o simulated")
    command = [sys.executable, "-m", "tacpipe", "sensors", "emulate", str(FOLDER / "first-paper.toml"), "simulated"]
    with subprocess.Popen(
        [*command, "-o", "emulated"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None and process.stderr is not None
        assert process.stdout.readline().strip() == "emulated/rig.toml"
        streams = rig.read(Path("emulated/rig.toml")).streams
        for name in ("proximity", "robot", "xela1"):
            link = open_link(streams[name].address, streams[name].sensor, name)
            awaited(partial(link.read, 0.2))
            link.close()
        process.send_signal(signal.SIGINT)
        output = process.stderr.read()
        assert process.wait() == 0
    assert "proximity: generic at serial:" in output
    assert "robot: generic at tcp:127.0.0.1:" in output and "instead of franka" in output


def test_recordings_without_a_stream_of_the_rig_are_refused(lab: Lab) -> None:
    lab.run("simulate forward --trials 1 --duration-s 4 -o simulated")
    ran = lab.call(f"sensors emulate {FOLDER / 'slide.toml'} simulated -o emulated")
    assert ran.code == 2
    assert "No recording has all streams of the rig file, biotac" in ran.err
    assert not Path("emulated").exists()
