"""Test dry runs, trials, triggers and time limits of recordings, with a clock that the test sets."""

import errno
import io
import json
import os
import re
import signal
import struct
import sys
from typing import Any

import numpy as np
import pytest

from tacpipe.recording import recorder, sealing
from tacpipe.recording.spool import Spooled
from tacpipe.sensors.framing import Chunks
from tests.conftest import Lab
from tests.recording import live
from tests.recording.scripted import Script
from tests.recording.test_reading import frames

FORCE = live.stream("force", "optoforce", "serial:/dev/none", "{ axes = 3, rate_hz = 333 }")
NUMBERS = '[{ name = "taxel", type = "u16", count = 4, unit = "count", quantity = "tactile" }]'
PAD = live.stream("pad", "generic", "udp::4010", f"{{ rate_hz = 100, packets = true, numbers = {NUMBERS} }}")
PROGRAM = live.stream("program", "tap", "udp::4011")
RATE_HZ, LASTS_S = 333, 20
REST, TOUCHED = 100, 1000  # counts


class Closed(io.StringIO):
    """Standard error behind which there is no terminal any more."""

    def write(self, text: str) -> int:
        """Fail as the kernel does."""
        raise OSError(errno.EIO, os.strerror(errno.EIO))


@pytest.fixture
def script(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> Script:
    """A rig with a force sensor that sends 333 frames a second for 20 s."""
    new_script = Script(monkeypatch)
    new_script.send("force", frames(RATE_HZ * LASTS_S), RATE_HZ)
    (lab.folder / "rig.toml").write_text(FORCE)
    return new_script


def seconds(shard: Any, name: str = "force") -> tuple[float, float]:
    """Return when the first and the last sample of a recorded stream came, in seconds of the script."""
    t_ns = shard.table(name).column("t_ns").to_numpy()
    return t_ns[0], t_ns[-1]


def counts(shard: Any) -> list[int]:
    """Return the counter of a recorded force sensor."""
    numbers: list[int] = shard.table("force").column("seq").to_pylist()
    return numbers


def test_a_dry_run_tells_rates_and_writes_nothing(lab: Lab, script: Script) -> None:
    before = sorted(lab.folder.rglob("*"))
    ran = lab.run("acquire rig.toml --dry-run")
    samples = int((script.t_s - recorder.TICK_S) * RATE_HZ) + 1  # the first comes at once, the last with the last tick

    assert 3 <= script.t_s < 3.2
    assert ran.out == f"force 333.0 Hz, jitter 0.0 ms, {samples} samples, 0 lost\n"
    report = json.loads(lab.run("acquire rig.toml --dry-run --json").out)
    assert report["schema_version"] == 1
    (figures,) = report["streams"].values()
    assert set(figures) == {"rate_hz", "jitter_ms", "latency_ms", "samples", "lost", "lost_estimated", "bytes_lost"}
    assert figures["rate_hz"] == pytest.approx(RATE_HZ) and (figures["lost"], figures["bytes_lost"]) == (0, 0)
    assert sorted(lab.folder.rglob("*")) == before


@pytest.mark.parametrize(
    ("sends_hz", "warning"), [(333, ""), (310, ""), (290, "; 333 Hz were expected"), (380, "; 333 Hz")]
)
def test_a_rate_that_is_a_tenth_off_the_rig_files_is_told(
    lab: Lab, script: Script, sends_hz: int, warning: str
) -> None:
    script.send("force", frames(20 * sends_hz), sends_hz)
    out = lab.run("acquire rig.toml --dry-run").out

    assert out.startswith(f"force {sends_hz}.0 Hz, jitter 0.0 ms, ")
    assert warning in out and (" were expected\n" in out) == bool(warning)


def test_frames_that_never_come_are_lost_in_a_dry_run(lab: Lab, script: Script) -> None:
    del script.sent["force"][100:107]

    assert ", 7 lost\n" in lab.run("acquire rig.toml --dry-run").out


def test_trials_last_as_long_as_asked_and_are_tared(lab: Lab, script: Script) -> None:
    lab.run("acquire rig.toml -o rec --duration-s 0.5 --trials 3 --name press")
    shards = live.shards(lab.folder)

    assert list(shards) == ["press-001", "press-002", "press-003"] and len(script.tared) == 3
    for shard in shards.values():
        numbers = counts(shard)
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers))) and shard.attributes["force_lost"] == 0
        assert 0.5 * RATE_HZ - 1 <= len(numbers) <= 0.55 * RATE_HZ + 1  # a tick of 50 ms longer at most


def test_a_stream_that_gives_nothing_is_awaited_for_three_seconds(lab: Lab, script: Script) -> None:
    script.sent.clear()
    refused = lab.call("acquire rig.toml -o rec --duration-s 1")

    assert refused.code == 5 and 3.0 <= script.t_s < 3.1
    assert "a frame of optoforce was awaited for 3 s, but nothing was received." in refused.err
    assert not (lab.folder / "rec").exists()


@pytest.mark.parametrize(("silent_s", "code"), [(1.8, 0), (2.1, 5)])
def test_a_stream_that_was_silent_for_two_seconds_at_the_end_is_lost(
    lab: Lab, script: Script, silent_s: float, code: int
) -> None:
    script.sent["force"] = script.sent["force"][: round(RATE_HZ * (4 - silent_s))]
    ran = lab.call("acquire rig.toml -o rec --duration-s 4")

    assert ran.code == code
    assert bool(re.search(r"nothing was received for 2\.[12] s, though it is open\.", ran.err)) == (code == 5)
    assert counts(live.only(lab.folder))[-1] == len(script.sent["force"]) - 1  # all samples are kept


def test_lines_of_standard_input_begin_and_end_trials(
    lab: Lab, script: Script, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, write = os.pipe()
    for at_s, typed in ((2.0, b"\n"), (3.0, b"\n\n"), (4.0, b"\n")):  # the lines at 3 s end and begin a trial
        script.happens.append((at_s, lambda typed=typed: os.write(write, typed)))  # type: ignore[misc]
    with os.fdopen(read) as source:
        monkeypatch.setattr(sys, "stdin", source)
        lab.run("acquire rig.toml -o rec --start key --stop key --trials 2 --name press")
    os.close(write)
    first, second = (counts(shard) for shard in live.shards(lab.folder).values())

    for numbers, begins_s, ends_s in ((first, 1.5, 3.0), (second, 2.5, 4.0)):  # half a second before is recorded too
        assert numbers == list(range(numbers[0], numbers[-1] + 1))
        assert begins_s - 0.01 <= numbers[0] / RATE_HZ <= begins_s + 0.11
        assert ends_s <= numbers[-1] / RATE_HZ <= ends_s + 0.11


def test_a_touch_begins_a_trial_and_half_a_second_without_ends_it(lab: Lab, script: Script) -> None:
    def taxels(number: int) -> bytes:
        touched = 200 <= number < 300 and not 240 <= number < 260  # a touch from 2 to 3 s, with a gap of 0.2 s
        return struct.pack("<4H", *[TOUCHED if touched else REST] * 4)

    script.send("pad", map(taxels, range(1000)), 100)
    (lab.folder / "rig.toml").write_text(PAD)
    lab.run("acquire rig.toml -o rec --start contact --stop contact --contact-count 500")
    values = live.only(lab.folder).table("pad").column("taxel01").to_numpy()
    touched = np.flatnonzero(values == TOUCHED)

    assert len(touched) == 80 and touched[-1] - touched[0] == 99
    assert 45 <= touched[0] <= 50  # half a second before the touch, less what the tick took to see it
    assert 50 <= len(values) - 1 - touched[-1] <= 61


def test_a_program_begins_and_ends_trials_and_a_start_meanwhile_begins_no_other(lab: Lab, script: Script) -> None:
    events = {2.0: "start", 2.5: "start", 3.0: "stop", 5.0: "start", 6.0: "stop"}
    script.sent["program"] = [(at_s, json.dumps({"event": event}).encode()) for at_s, event in events.items()]
    (lab.folder / "rig.toml").write_text(FORCE + PROGRAM)
    lab.run("acquire rig.toml -o rec --start tap --stop tap --trials 2 --name press")
    shards = live.shards(lab.folder)

    assert list(shards) == ["press-001", "press-002"]
    for shard, begins_s, ends_s in zip(shards.values(), (1.5, 4.5), (3.0, 6.0), strict=True):
        numbers = counts(shard)
        assert begins_s - 0.01 <= numbers[0] / RATE_HZ <= begins_s + 0.11
        assert ends_s <= numbers[-1] / RATE_HZ <= ends_s + 0.11
    first, second = (shard.table("program").column("event").to_pylist() for shard in shards.values())
    assert (first, second) == (["start", "start", "stop"], ["start", "stop"])


def test_lines_about_a_recording_come_every_five_seconds(lab: Lab, script: Script) -> None:
    created, *err = lab.run("acquire rig.toml -o rec --duration-s 12 --name one").err.splitlines()

    assert "created the store" in created
    assert [line.split(":")[0] for line in err] == ["recording one, 5 s", "recording one, 10 s", "one"]
    assert "force 333.0 Hz, jitter 0.0 ms" in err[0]


def test_a_long_sealing_is_no_silence_of_the_devices(lab: Lab, script: Script, monkeypatch: pytest.MonkeyPatch) -> None:
    seal = sealing.seal

    def slowly(*args: Any) -> Any:
        script.sleep(60.0)
        return seal(*args)

    monkeypatch.setattr(sealing, "seal", slowly)
    lab.run("acquire rig.toml -o rec --duration-s 1 --quiet")


def test_a_terminal_that_closes_ends_a_recording_which_is_sealed_though_nothing_can_be_printed(
    lab: Lab, script: Script, monkeypatch: pytest.MonkeyPatch
) -> None:
    def hang_up() -> None:
        monkeypatch.setattr(sys, "stderr", Closed())
        os.kill(os.getpid(), signal.SIGHUP)

    before = signal.signal(signal.SIGHUP, lambda *_: None)  # the signal must not end this process
    script.happens.append((6.0, hang_up))
    try:
        lab.run("acquire rig.toml -o rec --duration-s 15 --name one")
    finally:
        signal.signal(signal.SIGHUP, before)
    numbers = counts(live.only(lab.folder))

    assert numbers == list(range(numbers[0], numbers[-1] + 1))
    assert 5.9 <= numbers[-1] / RATE_HZ <= 6.11


def test_lines_that_cannot_be_printed_end_no_recording(
    lab: Lab, script: Script, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stderr", Closed())
    lab.run("acquire rig.toml -o rec --duration-s 12 --name one")  # a line every five seconds

    assert counts(live.only(lab.folder))[-1] >= 12 * RATE_HZ - 1


def test_a_crash_costs_what_came_since_the_last_tick(lab: Lab, script: Script) -> None:
    progress: list[tuple[float, int]] = []

    def look() -> None:
        (spool,) = live.spools(lab.folder)
        blocks = [block for _, block in Spooled(spool).blocks("force")]
        progress.append((script.t_s, sum(len(block.size) for block in blocks if isinstance(block, Chunks))))

    for at_s in np.linspace(1.0, 3.0, 11):
        script.happens.append((float(at_s), look))
    lab.run("acquire rig.toml -o rec --duration-s 4")
    first_number = counts(live.only(lab.folder))[0]

    assert len(progress) == 11
    for at_s, sample_count in progress:
        assert (at_s - recorder.TICK_S) * RATE_HZ - 1 <= first_number + sample_count <= at_s * RATE_HZ + 1
