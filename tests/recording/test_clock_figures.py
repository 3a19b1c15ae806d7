"""Test the clock figures of ten emulated minutes with a device clock 50 ppm off and 0.9 s lost."""

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.io.columns import Columns
from tacpipe.io.parquet import to_parquet
from tacpipe.plugins import registry
from tacpipe.recording import rig as rig_of
from tacpipe.recording import sealing
from tacpipe.recording.spool import Spool, Spooled
from tacpipe.sensors.encoding import split_frames
from tacpipe.sensors.framing import Chunks
from tacpipe.signals.clocks import fit_clock, host_times
from tests.sensors import made

MINUTES, SKEW_PPM, OFFSET_S = 10, 50.0, 12.345
BLOCK = 500  # samples that are encoded at once, the values of which are those of the block before
LOST_S = (300.0, 300.9)  # a part in the middle
RIG = """
[[stream]]
name = "device"
sensor = "{kind}"
transport = "{transport}"
options = {options}
"""
STREAMS = {
    "contactile": ("serial:/dev/ttyACM0", "{ rate_hz = 500 }"),  # its clock ticks in microseconds
    "xela": ("ws:127.0.0.1:5000", "{ rate_hz = 50 }"),
    "weiss-wts": ("serial:/dev/ttyACM0", "{ rate_hz = 100 }"),  # its clock has steps of 10 us
    "ur-rtde": ("tcp:127.0.0.1:30004", "{}"),  # its clock is a float in seconds
}


class Recorded:
    """A stream as it was recorded, beside when its samples were truly taken."""

    def __init__(self, kind: str, folder: Path) -> None:
        transport, options = STREAMS[kind]
        rig = rig_of.parse(RIG.format(kind=kind, transport=transport, options=options))
        sensor = rig.streams["device"].sensor
        self.rate_hz = sensor.rate_hz
        rng = np.random.default_rng(0)
        numbers = np.arange(round(MINUTES * 60 * self.rate_hz))
        taken_ns = np.rint(numbers * 1e9 / self.rate_hz).astype(np.int64)
        arrival_ns = np.maximum.accumulate(taken_ns + rng.exponential(1e6, len(numbers)).astype(np.int64))
        clock_ns = round(OFFSET_S * 1e9) + taken_ns + np.rint(taken_ns * SKEW_PPM * 1e-6).astype(np.int64)
        base = made.samples(kind, sensor, BLOCK)
        spool = Spool(folder, {"rig": "", "output": "", "recording": "r", "attributes": {}}, ["device"])
        for start in range(0, len(numbers), BLOCK):
            rows = slice(start, start + BLOCK)
            count = len(numbers[rows])
            block = made.select_rows(base, slice(0, count))
            counter = None if sensor.counter is None else numbers[rows] * sensor.step % sensor.counter
            block = replace(block, seq=counter, t_device_ns=clock_ns[rows])
            arrivals = zip(arrival_ns[rows].tolist(), split_frames(sensor, sensor.encode(block)), strict=True)
            received = [(t_ns, data) for t_ns, data in arrivals if not LOST_S[0] * 1e9 <= t_ns < LOST_S[1] * 1e9]
            spool.append("device", Chunks.from_pairs(received))
        spool.close()
        read = Spooled(spool.folder)
        read.header["clock"] = {"monotonic_ns": 0, "utc_ns": 0}  # stamps then compare with the true time
        self.sealed = sealing.seal_stream(read, rig, "device")
        self.table = self.sealed.table
        is_received = (arrival_ns < LOST_S[0] * 1e9) | (arrival_ns >= LOST_S[1] * 1e9)
        self.taken_ns = taken_ns[is_received]


@pytest.fixture(scope="module")
def xela(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """Ten minutes of a uSkin at 50 Hz."""
    return Recorded("xela", tmp_path_factory.mktemp("spool"))


@pytest.mark.long
@pytest.mark.parametrize("sensor", STREAMS)
def test_offset_is_found_to_half_a_sample_and_drift_to_two_ppm(sensor: str, tmp_path: Path) -> None:
    recorded = Recorded(sensor, tmp_path)
    assert recorded.table.num_rows == len(recorded.taken_ns)
    device_ns, arrival_ns = (recorded.table.column(name).to_numpy() for name in ("t_device_ns", "t_ns"))

    fit = fit_clock(device_ns, arrival_ns)

    assert len(fit.segments) == 1  # a loss is no restart
    assert abs(fit.drift_ppm + SKEW_PPM) < 2
    wrong_ns = np.abs(host_times(fit, device_ns, arrival_ns) - recorded.taken_ns)
    assert wrong_ns.max() < 0.5e9 / recorded.rate_hz
    if "seq" in recorded.table.column_names:
        gaps = np.diff(recorded.table.column("seq").to_numpy()) - 1
        assert recorded.sealed.lost == gaps.sum() == gaps.max() > 0.85 * recorded.rate_hz


def test_synchronize_tells_the_clock_masks_what_was_lost_and_keeps_the_stamps(xela: Recorded) -> None:
    class Recording:
        name, attributes, streams = "r", {"master": "device"}, ("device",)

        def columns(self, stream: str) -> Columns:
            return Columns(to_parquet(xela.table))

    stage = registry.load("synchronize")
    output: Any = stage(stage.params(rate_hz=50.0, values="interpolate"), Recording())

    assert abs(float(output.attributes["device_clock_drift_ppm"]) + SKEW_PPM) < 2
    assert float(output.attributes["device_clock_residual_ms"]) < 2
    table = output.streams[""]
    gap, t_ns = table.column("device_gap").to_numpy(zero_copy_only=False), table.column("t_ns").to_numpy()
    inside = (t_ns > (LOST_S[0] + 0.1) * 1e9) & (t_ns < (LOST_S[1] - 0.1) * 1e9)
    assert gap[inside].all() and inside.sum() > 30
    assert gap.sum() < 60  # no other rows are masked
    assert table.column("device_t_device_ns").type == pa.int64()


def test_another_judge_of_clocks_finds_the_same_drift(xela: Recorded, tmp_path: Path) -> None:
    pytest.importorskip("clockdoctor")
    device_ns, arrival_ns = (xela.table.column(name).to_numpy() for name in ("t_device_ns", "t_ns"))
    epoch_ns = 1_700_000_000 * 1_000_000_000  # it takes stamps near zero for none
    file = tmp_path / "rig_messages.jsonl"
    with file.open("w") as lines:
        for device, arrival in zip((device_ns + epoch_ns).tolist(), (arrival_ns + epoch_ns).tolist(), strict=True):
            stamp = {"sec": device // 1_000_000_000, "nanosec": device % 1_000_000_000}
            row = {"topic": "/device", "schema_name": "touch", "data": {"header": {"stamp": stamp, "frame_id": ""}}}
            lines.write(json.dumps({**row, "log_time_ns": arrival, "publish_time_ns": arrival}) + "\n")
    process = subprocess.run(
        [sys.executable, "-m", "clockdoctor.cli", str(file), "--out-dir", str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert not process.returncode, process.stderr
    drift = re.search(r"source skew:.*drift=([-+.\d]+)ppm", process.stdout)
    assert drift and abs(float(drift[1]) + SKEW_PPM) < 0.5
    assert abs(float(drift[1]) - fit_clock(device_ns, arrival_ns).drift_ppm) < 0.5
