"""Test live sessions with real processes and emulated devices: failures cost forecasts, never samples."""

import contextlib
import socket
import time
from pathlib import Path

import numpy as np
import pytest

from tacpipe.live.preparation import free_ports
from tacpipe.live.session import DIED, RESTARTED
from tacpipe.sensors import plan as plans
from tests.conftest import Lab, without_created_store
from tests.live.persistent import CHANNELS, HORIZON
from tests.live.sessions import await_from, ended, forecasts, started, subscriber, whole
from tests.recording import live, patient

pytestmark = pytest.mark.rig
SKIN = live.stream("skin", "xela", "ws:127.0.0.1:5000", "{ rate_hz = 50 }")


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    patient.relax(monkeypatch)


def test_what_is_published_is_recorded_to_the_bit_and_predicted_from_what_was_recorded(lab: Lab) -> None:
    with live.served(lab.folder, SKIN, live.WRENCH), subscriber() as (port, messages):
        options = f"-o rec --duration-s 2 --json --quantiles 90,10 --publish udp:127.0.0.1:{port}"
        printed = ended(started(lab, options))
    shard = live.only(lab.folder)
    table = shard.table("forecast")
    assert next(message for message in messages if message["kind"] == "description")["quantiles"] == [10, 90]
    published = {message["t_ns"]: np.array(message["values"], dtype=np.float32) for message in forecasts(messages)}
    names = [f"{channel}_t{step}" for step in range(1, HORIZON + 1) for channel in CHANNELS]
    recorded = np.column_stack([table.column(name).to_numpy() for name in names]).reshape(-1, HORIZON, len(CHANNELS))
    points = table.column("t_device_ns").to_numpy()
    assert len(points) > 10 and set(points.tolist()) <= set(published)
    assert all((published[t_ns] == values).all() for t_ns, values in zip(points.tolist(), recorded, strict=True))
    bands = {message["t_ns"]: np.array(message["quantiles"]["90"], dtype=np.float32) for message in forecasts(messages)}
    for level, above in ((10, -40), (90, 40)):  # the published level and the recorded one
        levels = np.column_stack([table.column(f"{name}_q{level}").to_numpy() for name in names])
        assert (levels == recorded.reshape(len(points), -1) + np.float32(above)).all()
    assert all((bands[t_ns].ravel() == row).all() for t_ns, row in zip(points.tolist(), levels, strict=True))

    skin = shard.table("skin")
    arrivals = skin.column("t_ns").to_numpy()
    values = np.column_stack([skin.column(name.removeprefix("skin_")).to_numpy() for name in CHANNELS])
    newest = values[np.searchsorted(arrivals, points, side="right") - 1].astype(np.float32)
    late = printed["live"]["late"]
    assert (
        int((recorded[:, 0] != newest).any(axis=1).sum()) <= late
    )  # other rows differ only where a sample came too late
    assert set(shard.streams) >= {"forecast", "latency"} and "live_model" in shard.attributes
    assert (shard.table("latency").column("latency_ms").drop_null().to_numpy() != 0).all()
    assert whole(shard, "skin") and whole(shard, "wrench")


def test_a_model_process_that_dies_is_started_anew_and_no_sample_is_lost(lab: Lab) -> None:
    with live.served(lab.folder, SKIN, live.WRENCH), subscriber() as (port, messages):
        process = started(lab, f"-o rec --json --publish udp:127.0.0.1:{port}", "die:40")
        await_from(
            process, lambda: len({message["seq"] for message in forecasts(messages)}) < len(forecasts(messages)) - 5
        )
        printed = ended(process, interrupt=True)
    shard = live.only(lab.folder)
    causes = [cause for cause, _ in live.events(shard, "forecast")]
    assert DIED in causes and RESTARTED in causes and printed["live"]["restarts"] >= 1
    assert whole(shard, "skin") and whole(shard, "wrench")


def test_a_model_that_is_too_slow_costs_forecasts_which_are_counted_and_no_sample(lab: Lab) -> None:
    with live.served(lab.folder, SKIN, live.WRENCH):
        printed = ended(started(lab, "-o rec --duration-s 3 --json", "slow:0.2"))
    shard = live.only(lab.folder)
    assert printed["live"]["skipped"] > printed["live"]["forecasts"] > 0
    assert whole(shard, "skin") and whole(shard, "wrench")


def test_a_stream_that_goes_away_costs_the_forecasts_until_it_is_back(lab: Lab) -> None:
    with live.served(lab.folder, SKIN, live.WRENCH) as rig, subscriber() as (port, messages):
        process = started(lab, f"-o rec --json --publish udp:127.0.0.1:{port}")
        await_from(process, lambda: len(forecasts(messages)) > 20)
        rig.unplug("skin")
        await_from(process, lambda: "skin" in messages[-1].get("cause", "") and messages[-1]["values"] is None)
        rig.replug("skin")
        count = len(messages)
        await_from(process, lambda: len(forecasts(messages[count:])) > 20)
        ended(process, interrupt=True)
    shard = live.only(lab.folder)
    assert whole(shard, "wrench") and "lost" in [cause for cause, _ in live.events(shard, "skin")]


@pytest.mark.parametrize("stream", [live.WRENCH, live.stream("skin", "tfmini", "serial:/dev/ttyUSB3")])
def test_a_rig_without_what_the_model_reads_is_refused_in_one_sentence(lab: Lab, stream: str) -> None:
    Path(lab.folder / "rig.toml").write_text(f"{live.RANGE}{stream}")
    process = started(lab, "-o rec --duration-s 1")
    _, err = process.communicate()
    assert process.returncode == 2 and "skin" in err and len(without_created_store(err).strip().splitlines()) == 1
    assert not (lab.folder / "rec").exists()


def test_packets_that_are_no_plan_or_of_another_sender_are_counted_and_not_kept(lab: Lab) -> None:
    (place,) = free_ports(1)
    poses = np.tile([0.5, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0], (4, 1))
    garbage = b"x" * 20_000
    with live.served(lab.folder, SKIN), subscriber() as (port, messages), contextlib.ExitStack() as opened:
        process = started(
            lab, f"-o rec --json --plan udp::{place} --plan-from 127.0.0.2 --publish udp:127.0.0.1:{port}"
        )
        await_from(process, lambda: len(forecasts(messages)) > 5)
        allowed, foreign = (opened.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2))
        allowed.bind(("127.0.0.2", 0))
        for _ in range(10):
            plan = plans.packet((time.time_ns() + np.arange(4) * 10**8).tolist(), poses)
            for sender, data in ((allowed, plan), (foreign, plan), *[(allowed, garbage)] * 100):
                sender.sendto(data, ("127.0.0.1", place))
            time.sleep(0.05)  # the kernel's queue holds 8 MB where it grants that
        assert sum((path / "bytes").stat().st_size for path in live.spools(lab.folder)) < 1_000_000
        ended(process, interrupt=True)
    shard = live.only(lab.folder)
    assert shard.table("plan").num_rows == 40
    rows = [row for row in shard.table("events").to_pylist() if row["stream"] == "plan"]
    counts = {
        cause: sum(int(row["detail"].split()[0]) for row in rows if row["cause"] == cause)
        for cause in ("foreign", "refused")
    }
    assert counts == {"foreign": 10, "refused": 1000}


def test_without_an_output_nothing_is_kept_and_figures_are_printed(lab: Lab) -> None:
    with live.served(lab.folder, SKIN), subscriber() as (port, messages):
        process = started(lab, f"--json --publish udp:127.0.0.1:{port}")
        await_from(process, lambda: len(forecasts(messages)) > 20)
        printed = ended(process, interrupt=True)
    assert printed["live"]["forecasts"] > 20 and printed["recordings"] == [] and printed["output"] is None
    assert not (lab.folder / "rec").exists()
