"""Test that a recorder that was stopped, starved or suspended reports it, and how uncertain the late arrivals are."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacpipe.io.columns import Columns
from tacpipe.io.parquet import to_parquet
from tacpipe.links import network
from tacpipe.plugins import registry
from tacpipe.recording import clock, pace, sealing
from tacpipe.recording import rig as rig_of
from tacpipe.recording.pace import MIN_CATCH_UP_NS, STALL_NS, Pace
from tacpipe.recording.rig import Rig
from tacpipe.recording.sealing import Sealed
from tacpipe.recording.spool import Spool, Spooled, StreamNote
from tacpipe.recording.station import READ_S, Station
from tacpipe.sensors.encoding import split_frames
from tacpipe.sensors.sensor import LocalAddress
from tests.conftest import Lab
from tests.recording import live
from tests.recording.scripted import Script
from tests.recording.test_reading import frames
from tests.recording.test_schedule import RATE_HZ, counts
from tests.sensors import made

MS, S = 1_000_000, 1_000_000_000
START_NS = 1000 * S
READ_NS = round(READ_S * 1e9)


class Device:
    """A serial device that sends a frame a millisecond, and a computer that stops now and then."""

    overruns = foreign = 0
    local: LocalAddress = {}  # noqa: RUF012

    def __init__(self, monkeypatch: pytest.MonkeyPatch, sent: list[bytes], stops: dict[int, int], asleep: bool = False):
        self.now_ns, self.asleep_ns = START_NS, 0
        self.kernel_stamped = False
        self.sent = [(START_NS + (row + 1) * MS, frame) for row, frame in enumerate(sent)]
        self.stops = {START_NS + at_ms * MS: lasts_ms * MS for at_ms, lasts_ms in stops.items()}
        self.suspends = asleep
        self.station: Any = None
        monkeypatch.setattr(clock, "now_ns", lambda: self.now_ns)
        monkeypatch.setattr(clock, "suspended_ns", lambda: self.asleep_ns)

    def read(self, timeout_s: float) -> list[tuple[int, bytes]]:
        """Wait for what is sent next, and return all that waits with the time at which it is read."""
        until_ns = min(self.now_ns + round(timeout_s * 1e9), self.sent[0][0] if self.sent else self.now_ns)
        self.now_ns = max(self.now_ns + 20_000, until_ns)
        for at_ns in [at_ns for at_ns in self.stops if at_ns <= self.now_ns]:
            lasts_ns = self.stops.pop(at_ns)
            if self.suspends:  # the device was without power, and continues where it was
                self.asleep_ns += lasts_ns
            else:
                self.now_ns += lasts_ns
        due = [chunk for chunk in self.sent if chunk[0] <= self.now_ns][:500]  # no more fits into one read
        self.sent = self.sent[len(due) :]
        if not self.sent:
            self.station._stopping.set()
        return [(chunk[0] if self.kernel_stamped else self.now_ns, chunk[1]) for chunk in due]

    def write(self, data: bytes) -> None:
        """Take nothing."""

    def close(self) -> None:
        """End."""


RIG = rig_of.parse(live.stream("force", "optoforce", "serial:/dev/none", "{ axes = 3, rate_hz = 1000 }"))


def record(folder: Path, device: Device, rig: Rig = RIG) -> Sealed:
    """Return the stream as it is sealed that a device sent."""
    ((name, stream),) = rig.streams.items()
    device.station = reader = Station(stream)
    reader._link = device
    spool = Spool(folder, {"rig": "", "output": "", "recording": "r", "attributes": {}}, [name])
    reader._read()
    for block in reader.take():
        spool.note(block) if isinstance(block, StreamNote) else spool.append(name, block)
    spool.close()
    read = Spooled(spool.folder)
    read.header["clock"] = {"monotonic_ns": 0, "utc_ns": 0}
    return sealing.seal_stream(read, rig, name)


def stalls(sealed: Sealed) -> list[tuple[int, str]]:
    """Return time and detail of each stall in ms after the start."""
    return [((event.t_ns - START_NS) // MS, event.detail) for event in sealed.events if event.cause == pace.STALLED]


def test_a_recorder_that_is_never_held_up_says_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sealed = record(tmp_path, Device(monkeypatch, frames(5000), {1000: 80, 2000: 60}))  # ordinary delays

    assert not sealed.events and not sealed.uncertain
    assert sealing.UNCERTAIN not in sealed.table.column_names


def test_a_link_is_drained_when_a_read_found_nothing_waiting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    device = Device(monkeypatch, frames(5000), {1000: 2000})  # 2,000 frames wait then, and a read gives 500
    read, reads = device.read, []

    def noted(timeout_s: float) -> list[tuple[int, bytes]]:
        reads.append((len(chunks := read(timeout_s)), device.station.is_drained(START_NS + 3000 * MS)))
        return chunks

    device.read = noted  # type: ignore[method-assign]
    record(tmp_path, device)
    full_reads = [drained for count, drained in reads if count == 500]
    assert len(full_reads) == 4 and not any(full_reads)  # each is the state after the read before it
    assert [drained for _, drained in reads][-1]


@pytest.mark.parametrize("lasts_ms", [250, 460, 5000])
def test_what_waited_while_the_recorder_was_stopped_has_an_uncertain_arrival(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lasts_ms: int
) -> None:
    sealed = record(tmp_path, Device(monkeypatch, frames(8000), {1000: lasts_ms}))
    table = sealed.table
    t_ns, uncertain_ns = (table.column(name).to_numpy() for name in ("t_ns", sealing.UNCERTAIN))
    sent_ns = START_NS + (table.column("seq").to_numpy() + 1) * MS
    late = t_ns - sent_ns > MS

    ((at_ms, detail),) = stalls(sealed)
    assert at_ms == 1000 + lasts_ms and f"stamped up to {lasts_ms / 1000 + 0.001:.3f} s late" in detail
    assert late.sum() >= lasts_ms - 2 and (uncertain_ns[late] > 0).all()
    assert (sent_ns >= t_ns - np.maximum(uncertain_ns, MS)).all()  # when it truly came lies within what is given
    assert sealed.uncertain == np.count_nonzero(uncertain_ns) <= lasts_ms + MIN_CATCH_UP_NS // MS + 5
    assert sealed.lost == 0


def test_stamps_of_the_kernel_are_right_however_late_they_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = Device(monkeypatch, frames(5000), {1000: 2000})
    device.kernel_stamped = True
    sealed = record(tmp_path, device)

    assert len(stalls(sealed)) == 1 and not sealed.uncertain


def test_time_in_which_the_computer_was_suspended_is_in_the_stamps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sealed = record(tmp_path, Device(monkeypatch, frames(4000), {1000: 3_600_000}, asleep=True))
    steps_ns = np.diff(sealed.table.column("t_ns").to_numpy())

    ((_, detail),) = stalls(sealed)
    assert "the computer was suspended for 3600.000 s of it" in detail
    assert (steps_ns > 3600 * S).sum() == 1 and steps_ns.max() < 3601 * S


def test_a_device_that_takes_its_time_is_no_stall() -> None:
    pace = Pace(0, 0)
    now_ns = 0
    for waited_ns in (READ_NS, 10 * MS, READ_NS + STALL_NS // 2):
        assert pace.add_read(now_ns, now_ns + waited_ns, READ_NS, 0) is None
        now_ns += waited_ns
    pace.resume(now_ns + 5 * S)  # it was tared meanwhile
    assert pace.add_read(now_ns + 5 * S, now_ns + 5 * S + MS, READ_NS, 0) is None


def test_a_datagram_says_whether_the_kernel_stamped_it() -> None:
    link = network.UdpLink("x", network.bind_port("127.0.0.1", 0, "x"), prompt=True)
    try:
        link._arrival_ns([])
        assert not link.kernel_stamped
        link._arrival_ns([(1, network.STAMPS, bytes(16))])
        assert link.kernel_stamped
    finally:
        link.close()


def test_a_clock_is_fitted_to_what_arrived_in_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = rig_of.parse(live.stream("pad", "contactile", "serial:/dev/none", "{ rate_hz = 1000 }"))
    sensor = rig.streams["pad"].sensor
    rows = np.arange(9000)
    samples = made.samples("contactile", sensor, len(rows))
    samples = type(samples)(samples.values, seq=rows, t_device_ns=rows * MS)
    sent = split_frames(sensor, sensor.encode(samples))
    # the fastest arrivals are those of a recorder that was starved all through the second half, but for moments
    device = Device(monkeypatch, sent, dict.fromkeys(range(1000, 8600, 310), 300))
    table = record(tmp_path, device, rig).table

    class Recording:
        name, attributes, streams = "r", {"master": "pad"}, ("pad",)

        def columns(self, stream: str) -> Columns:
            return Columns(to_parquet(table))

    stage = registry.load("synchronize")
    made_of: Any = stage(stage.params(values="interpolate"), Recording())

    assert float(made_of.attributes["pad_clock_residual_ms"]) < 0.1
    assert abs(float(made_of.attributes["pad_clock_drift_ppm"])) < 1
    assert not [name for name in made_of.streams[""].column_names if "uncertain" in name]


def slow_to_finish(script: Script, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the disk take 3 s for the last of a spool."""
    finish = Spool.finish

    def slowly(spool: Spool) -> None:
        script.sleep(3.0)
        finish(spool)

    monkeypatch.setattr(Spool, "finish", slowly)


def test_a_disk_that_is_slow_at_the_end_is_no_silence_of_the_device(
    lab: Lab, script: Script, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow_to_finish(script, monkeypatch)
    lab.run("acquire rig.toml -o rec --duration-s 4")

    assert counts(live.only(lab.folder))[-1] >= 4 * RATE_HZ - 1


@pytest.mark.parametrize(("stopped_s", "fetched_s"), [(0.5, 0.01), (5.0, 0.01), (2.0, 1.2)])
def test_a_recorder_that_was_stopped_at_the_end_blames_no_device(
    lab: Lab, script: Script, monkeypatch: pytest.MonkeyPatch, stopped_s: float, fetched_s: float
) -> None:
    """Readers that are starved of a processor fetch what waited only later: ``fetched_s`` after the end of the stop."""
    read = script.sent["force"]
    at_s = 3.99
    script.drained_s = at_s + stopped_s + fetched_s
    script.sent["force"] = [(t_s if t_s < at_s else max(t_s, script.drained_s), data) for t_s, data in read]
    script.happens.append((at_s, lambda: setattr(script, "t_ns", script.t_ns + round(stopped_s * 1e9))))
    lab.run("acquire rig.toml -o rec --duration-s 4")

    assert counts(live.only(lab.folder))[-1] >= (at_s + stopped_s) * RATE_HZ - 1  # the samples that waited are fetched


def test_a_recorder_that_is_stopped_at_the_start_awaits_the_first_sample_as_long_as_ever(
    lab: Lab, script: Script
) -> None:
    script.sent["force"] = [(t_s + 7.0, data) for t_s, data in script.sent["force"]]
    script.happens.append((1.0, lambda: setattr(script, "t_ns", script.t_ns + 5 * S)))

    assert lab.call("acquire rig.toml -o rec --duration-s 1").code == 0


def test_a_device_that_is_silent_is_blamed_though_the_disk_is_slow_too(
    lab: Lab, script: Script, monkeypatch: pytest.MonkeyPatch
) -> None:
    script.sent["force"] = script.sent["force"][: RATE_HZ * 2]
    slow_to_finish(script, monkeypatch)
    ran = lab.call("acquire rig.toml -o rec --duration-s 5")

    assert ran.code == 5 and "nothing was received for 3." in ran.err


def test_time_is_told_by_two_clocks_that_agree() -> None:
    assert clock.suspended_ns() == pytest.approx(
        time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.monotonic_ns(), abs=S
    )
