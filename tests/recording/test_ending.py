"""Test that Ctrl-C ends and keeps a recording, and that a second one while it is sealed leaves it to `acquire --recover`."""

import contextlib
import fcntl
import json
import os
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tacpipe.io.termination import TWICE_S
from tacpipe.recording import sealing
from tests.conftest import Lab, without_created_store
from tests.emulation.emulator import Emulator
from tests.recording import live

Interrupt = Callable[..., None]


@pytest.fixture
def rig(lab: Lab) -> Iterator[Emulator]:
    with live.served(lab.folder, live.FORCE, live.SKIN) as emulator:
        yield emulator


@pytest.fixture
def while_sealing() -> Iterator[Interrupt]:
    """A function that has the next recording interrupted so many times while it is sealed."""
    patch, real = pytest.MonkeyPatch(), sealing.seal

    def interrupt(times: int, apart_s: float = 2 * TWICE_S, number: signal.Signals = signal.SIGINT) -> None:
        def seal(*args: Any) -> Any:
            patch.undo()
            for _ in range(times):
                os.kill(os.getpid(), number)
                time.sleep(apart_s)
            return real(*args)

        patch.setattr(sealing, "seal", seal)

    yield interrupt
    patch.undo()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_a_recording_and_it_is_sealed(lab: Lab, rig: Emulator, number: signal.Signals) -> None:
    process = live.started(lab.folder, "--name one --json")
    (spool,) = live.awaited(lambda: live.spools(lab.folder))
    live.awaited(lambda: (spool / "bytes").stat().st_size > 4000)
    process.send_signal(number)
    out, err = process.communicate()

    assert process.returncode == 0, err
    (report,) = json.loads(out)["recordings"]
    shard = live.only(lab.folder)
    assert report["name"] == "one" and not live.spools(lab.folder)
    for name in ("force", "skin"):
        rows = live.recorded(shard, name)
        live.place(rows, live.sent(rig, name))
        assert report["rows"][name] == len(rows) and shard.attributes[f"{name}_lost"] == 0


@pytest.mark.parametrize("options", ["", "--stop key"])
def test_a_terminal_that_is_closed_ends_a_recording_and_it_is_sealed(lab: Lab, rig: Emulator, options: str) -> None:
    master, slave = os.openpty()
    process = live.started(
        lab.folder,
        f"--name one {options}",
        stdin=slave,
        stdout=slave,
        stderr=slave,
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    )
    os.close(slave)
    os.set_blocking(master, False)

    def recorded() -> bool:
        with contextlib.suppress(BlockingIOError):
            os.read(master, 1 << 16)  # the display; a terminal that nobody reads takes no more after a while
        return any((spool / "bytes").stat().st_size > 4000 for spool in live.spools(lab.folder))

    live.awaited(recorded)
    os.close(master)  # every later write to the terminal is an error

    assert process.wait() == 0
    shard = live.only(lab.folder)
    assert not live.spools(lab.folder)
    live.place(live.recorded(shard, "force"), live.sent(rig, "force"))


def test_a_signal_ends_the_trials_that_are_left(lab: Lab, rig: Emulator) -> None:
    process = live.started(lab.folder, "--name press --trials 50 --duration-s 0.5")
    live.awaited(lambda: (lab.folder / "rec/manifest.json").exists())
    process.send_signal(signal.SIGINT)
    _, err = process.communicate()
    names = list(live.shards(lab.folder))

    assert process.returncode == 0, err
    assert names == [f"press-{number:03d}" for number in range(1, len(names) + 1)] and len(names) < 50


def test_a_signal_before_the_first_trial_records_nothing(lab: Lab, rig: Emulator) -> None:
    process = live.started(lab.folder, "--start contact --contact-count 1e9 --duration-s 1")
    live.awaited(lambda: len(rig.ledger["skin"]))
    process.send_signal(signal.SIGINT)
    _, err = process.communicate()

    assert process.returncode == 0, err
    assert not (lab.folder / "rec").exists() and not live.spools(lab.folder)


def test_a_terminal_that_closes_and_its_shell_are_one_request_however_far_apart(
    lab: Lab, rig: Emulator, while_sealing: Interrupt
) -> None:
    while_sealing(3, number=signal.SIGHUP)
    lab.run("acquire rig.toml -o rec --duration-s 0.5")

    live.place(live.recorded(live.only(lab.folder), "force"), live.sent(rig, "force"))


def test_one_signal_while_sealing_changes_nothing(lab: Lab, rig: Emulator, while_sealing: Interrupt) -> None:
    while_sealing(1)
    lab.run("acquire rig.toml -o rec --duration-s 0.5")

    live.place(live.recorded(live.only(lab.folder), "force"), live.sent(rig, "force"))


def test_two_signals_at_once_are_one_wish(
    lab: Lab, rig: Emulator, while_sealing: Interrupt, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tacpipe.io.termination.TWICE_S", 1000.0)  # however slow the computer is between the two
    while_sealing(2, 0)  # `timeout` also signals a process and then its group
    lab.run("acquire rig.toml -o rec --duration-s 0.5")

    live.place(live.recorded(live.only(lab.folder), "force"), live.sent(rig, "force"))


def test_a_second_signal_ends_a_sealing_that_hears_of_none(lab: Lab, rig: Emulator) -> None:
    script = (
        "import hashlib, sys; from tacpipe.cli import main as cli; from tacpipe.recording import sealing;"
        "sealing.seal = lambda *_: (print('sealing', flush=True), hashlib.pbkdf2_hmac('sha256', b'', b'', 2**31 - 1));"
        "sys.argv = ['tacpipe', *'acquire rig.toml -o rec --name one --quiet'.split()]; cli.main()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", script], cwd=lab.folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    (spool,) = live.awaited(lambda: live.spools(lab.folder))
    live.awaited(lambda: (spool / "bytes").stat().st_size > 4000)
    process.send_signal(signal.SIGINT)
    assert process.stdout is not None and process.stdout.readline() == "sealing\n"
    time.sleep(2 * TWICE_S)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate()

    assert process.returncode == 130
    assert err == f"tacpipe: interrupted. The recorded data is in {spool}; `tacpipe acquire --recover` seals it.\n"
    assert lab.run("acquire --recover").err.startswith("recovered one: ")


def test_a_second_signal_while_sealing_leaves_the_spool_and_it_is_recovered(
    lab: Lab, rig: Emulator, while_sealing: Interrupt
) -> None:
    while_sealing(2)
    interrupted = lab.call("acquire rig.toml -o rec --duration-s 0.5 --name one")
    (spool,) = live.spools(lab.folder)

    assert interrupted.code == 130 and not (lab.folder / "rec").exists()
    assert without_created_store(interrupted.err) == (
        f"tacpipe: interrupted. The recorded data is in {spool}; `tacpipe acquire --recover` seals it.\n"
    )
    recovered = lab.run("acquire --recover")
    assert recovered.err.startswith("recovered one: ") and recovered.err.count("\n") == 1
    live.place(live.recorded(live.only(lab.folder), "force"), live.sent(rig, "force"))
    assert not live.spools(lab.folder)
