"""Test that a key, a touch or an event of another program begins and ends a trial, with the time before it."""

import json
import os
import signal
import socket
import struct
import subprocess
import termios
import threading

import pytest

from tacpipe.recording import triggers
from tacpipe.simulation.emulation.network import free_port
from tests.conftest import Lab
from tests.emulation.emulator import Emulator
from tests.recording import live

REST, TOUCHED = 100, 1000  # counts


class Pad(threading.Thread):
    """Four taxels that send datagrams: at rest until ``rested``, then touched until a recording runs, then at rest."""

    def __init__(self, lab: Lab) -> None:
        super().__init__(daemon=True)
        self.port, self.lab = free_port(), lab
        self.rested, self.ended = threading.Event(), threading.Event()
        numbers = '[{ name = "taxel", type = "u16", count = 4, unit = "count", quantity = "tactile" }]'
        options = f"{{ rate_hz = 100, packets = true, numbers = {numbers} }}"
        (lab.folder / "rig.toml").write_text(live.stream("pad", "generic", f"udp::{self.port}", options))

    def run(self) -> None:
        touched = 0
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
            while not self.ended.wait(0.01):
                pressed = self.rested.is_set() and touched < 20
                touched += pressed and bool(live.spools(self.lab.folder))
                wire.sendto(struct.pack("<4H", *[TOUCHED if pressed else REST] * 4), ("127.0.0.1", self.port))


def enough(rig: Emulator, samples: int) -> None:
    """Wait until the rig has sent so many samples more."""
    before = len(rig.ledger["force"])
    live.awaited(lambda: len(rig.ledger["force"]) > before + samples)


def test_lines_of_standard_input_begin_and_end_trials(lab: Lab, rig: Emulator) -> None:
    process = live.started(lab.folder, "--start key --stop key --trials 2 --name press", stdin=subprocess.PIPE)
    assert process.stdin is not None
    enough(rig, 300)
    process.stdin.write("\n")
    process.stdin.flush()
    live.awaited(lambda: live.spools(lab.folder))
    enough(rig, 50)
    process.stdin.write("\n\n")  # one ends the first trial, one begins the second
    process.stdin.flush()
    live.awaited(lambda: (lab.folder / "rec/manifest.json").exists() and live.spools(lab.folder))
    enough(rig, 50)
    _, err = process.communicate("\n")

    assert process.returncode == 0, err
    shards = live.shards(lab.folder)
    assert list(shards) == ["press-001", "press-002"]
    for shard in shards.values():
        live.place(live.recorded(shard, "force"), live.sent(rig, "force"))


def test_keys_of_a_terminal_begin_and_end_a_trial_and_its_settings_are_put_back(lab: Lab, rig: Emulator) -> None:
    master, slave = os.openpty()
    before = termios.tcgetattr(slave)
    process = live.started(lab.folder, "--start key --stop key --name press", stdin=slave)
    live.awaited(lambda: not termios.tcgetattr(slave)[3] & termios.ICANON)
    os.write(master, b"x")  # no key that counts
    enough(rig, 100)
    assert not live.spools(lab.folder)
    os.write(master, b" ")
    live.awaited(lambda: live.spools(lab.folder))
    enough(rig, 50)
    os.write(master, b"\n")
    _, err = process.communicate()

    assert process.returncode == 0, err
    assert termios.tcgetattr(slave) == before
    live.place(live.recorded(live.only(lab.folder), "force"), live.sent(rig, "force"))
    os.close(master)
    os.close(slave)


def test_a_terminal_is_left_alone_where_no_key_is_asked_for(lab: Lab, rig: Emulator) -> None:
    master, slave = os.openpty()
    process = live.started(lab.folder, "--stop duration", stdin=slave)
    live.awaited(lambda: live.spools(lab.folder))

    assert termios.tcgetattr(slave)[3] & termios.ICANON
    process.send_signal(signal.SIGINT)
    process.communicate()
    os.close(master)
    os.close(slave)


@pytest.mark.rig
def test_a_touch_begins_a_trial_and_its_end_ends_it(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    pad = Pad(lab)

    class Seen(triggers.ContactTrigger):
        def touched(self) -> bool:
            if all(watch.rest_level is not None for watch in self._watches.values()):
                pad.rested.set()
            return super().touched()

    monkeypatch.setattr(triggers, "ContactTrigger", Seen)
    pad.start()
    lab.run("acquire rig.toml -o rec --start contact --stop contact --contact-count 500")
    pad.ended.set()
    pad.join()
    values = live.only(lab.folder).table("pad").column("taxel01").to_numpy()
    touched = (values == TOUCHED).nonzero()[0]

    assert TOUCHED in values
    assert values[-1] == REST
    assert touched[-1] - touched[0] + 1 == len(touched)


def test_a_rig_without_taxels_cannot_wait_for_a_touch(lab: Lab, rig: Emulator) -> None:
    refused = lab.call("acquire rig.toml -o rec --start contact --duration-s 1")

    assert refused.code == 2 and "No stream of this rig has tactile channels" in refused.err
    assert not live.spools(lab.folder)


def test_a_program_begins_and_ends_trials(lab: Lab, rig: Emulator) -> None:
    port = free_port()
    with (lab.folder / "rig.toml").open("a") as file:
        file.write(live.stream("program", "tap", f"udp::{port}"))
    process = live.started(lab.folder, "--start tap --stop tap --trials 2 --name press")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:

        def say(event: str) -> bool:
            wire.sendto(json.dumps({"event": event}).encode(), ("127.0.0.1", port))
            return True

        live.awaited(lambda: say("start") and live.spools(lab.folder))
        enough(rig, 100)
        say("stop")
        say("start")  # while the first trial is sealed
        live.awaited(lambda: (lab.folder / "rec/manifest.json").exists() and live.spools(lab.folder))
        enough(rig, 100)
        say("stop")
        _, err = process.communicate()

    assert process.returncode == 0, err
    shards = live.shards(lab.folder)
    assert list(shards) == ["press-001", "press-002"]
    for shard in shards.values():
        live.place(live.recorded(shard, "force"), live.sent(rig, "force"))
    first, second = (shard.table("program").column("event").to_pylist() for shard in shards.values())
    assert first[0] == "start" and "stop" in first and second[-1] == "stop"


def test_a_rig_without_a_tap_cannot_wait_for_a_word(lab: Lab, rig: Emulator) -> None:
    refused = lab.call("acquire rig.toml -o rec --stop tap")

    assert refused.code == 2 and 'This rig has no stream of sensor "tap"' in refused.err
