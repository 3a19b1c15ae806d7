"""Published trials replayed through live sessions at their own rate: the table of live against offline.

    python benchmarks/live_replay.py RECORDINGS MODEL -o FOLDER --split SPLIT --alarms-on SEGMENTS [--trials 6] [--realtime]

``RECORDINGS`` are trials as `tacpipe ingest xela-flat` reads them; those of the split's role ``test`` are replayed, which
MODEL must not have seen. Each row goes out as a datagram a stream, at the trial's rate, the master's last. Before the
session records, the first row is repeated. The session publishes to this program, which by that knows when to begin.
At the end `tacpipe evaluate MODEL FOLDER/live --live` is run, and its table of live against offline printed.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import tacpipe
from tacpipe.live.own_streams import free_ports
from tacpipe.recording import rig as rigs
from tacpipe.recording.rig import Rig
from tacpipe.sensors.sensor import Samples

STREAMS = ("robot", "xela2", "xela1")  # in the order in which they are sent
MASTER = "xela1"
TAIL_S = 0.5  # of the last row repeated, so that the last forecasts come out
START_S = 60.0  # in which a session must begin to forecast
END_S = 600.0  # in which what was recorded is decoded and written
KINDS = {"uint16": "u16", "double": "f64", "float": "f32"}


def rig(tables: Mapping[str, Any], rate_hz: float, ports: Mapping[str, int]) -> str:
    """Return a rig file of boards that send the columns of these tables as they are recorded."""
    lines = [f'master = "{MASTER}"', ""]
    for name in STREAMS:
        lines += ["[[stream]]", f'name = "{name}"', 'sensor = "generic"', f'transport = "udp::{ports[name]}"']
        lines += ["[stream.options]", f"rate_hz = {rate_hz:.9g}", "packets = true", "numbers = ["]
        if name.startswith("xela"):
            lines.append('    { name = "taxel", type = "u16", count = 16, axes = "xyz", unit = "count" },')
        else:
            for field in tables[name].schema:
                if field.name != "t_ns":
                    about = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
                    lines.append(
                        f'    {{ name = "{field.name}", type = "{KINDS[str(field.type)]}", unit = "{about["unit"]}", '
                        f'quantity = "{about["quantity"]}" }},'
                    )
        lines += ["]", ""]
    return "\n".join(lines)


def packets(made: Rig, tables: Mapping[str, Any], rows: int) -> dict[str, list[bytes]]:
    """Return the datagram of each row of each stream."""
    found = {}
    for name in STREAMS:
        values = np.column_stack(
            [tables[name].column(one).to_numpy() for one in tables[name].column_names if one != "t_ns"]
        )
        sensor = made.streams[name].sensor
        frames = sensor.encode(Samples((values[:rows],)))
        found[name] = [bytes(np.asarray(one)) for one in frames]
    return found


def replayed(folder: Path, model: Path, name: str, tables: Mapping[str, Any], chosen: argparse.Namespace) -> None:
    """Replay one trial through a session that records into ``folder/live``."""
    t_ns = tables[MASTER].column("t_ns").to_numpy()
    rows = min(tables[one].num_rows for one in STREAMS)
    period_s = float(np.median(np.diff(t_ns))) / 1e9
    *numbers, answers = free_ports(len(STREAMS) + 1)
    ports = dict(zip(STREAMS, numbers, strict=True))
    rig_file = folder / f"{name}.toml"
    rig_file.write_text(rig(tables, 1 / period_s, ports))
    sent = packets(rigs.read(rig_file), tables, rows)
    words = [sys.executable, "-m", "tacpipe", "live", str(rig_file), "--model", str(model), "-o", str(folder / "live")]
    words += ["--name", name, "--quiet", "--steps", "1,3,5,10", "--publish", f"udp:127.0.0.1:{answers}"]
    words += [
        "--alarms-per-hour",
        f"{chosen.per_hour:g}",
        "--alarms-on",
        str(chosen.alarms_on),
        "--split",
        str(chosen.split),
    ]
    words += ["--realtime"] * chosen.realtime
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as hearing,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link,
    ):
        hearing.bind(("127.0.0.1", answers))
        hearing.setblocking(False)
        with subprocess.Popen(words) as session:
            paced(link, ports, sent, period_s, rows, hearing, session)
            session.send_signal(signal.SIGTERM)
            session.wait(END_S)


def paced(
    link: socket.socket,
    ports: Mapping[str, int],
    sent: Mapping[str, Sequence[bytes]],
    period_s: float,
    rows: int,
    hearing: socket.socket,
    session: subprocess.Popen[bytes],
) -> None:
    """Send the first row until the session publishes forecasts, then the trial."""
    due_s = time.monotonic()
    row, until_s, tail = 0, due_s + START_S, round(TAIL_S / period_s)
    while row < rows + tail:
        for name in STREAMS:
            link.sendto(sent[name][min(row, rows - 1)], ("127.0.0.1", ports[name]))
        if row or forecasts(hearing):
            row += 1
        elif time.monotonic() > until_s or session.poll() is not None:
            raise SystemExit("The session did not begin to forecast.")
        due_s += period_s
        time.sleep(max(0.0, due_s - time.monotonic()))


def forecasts(hearing: socket.socket) -> bool:
    """Return whether a message with a forecast came."""
    while True:
        try:
            message = json.loads(hearing.recv(1 << 16))
        except BlockingIOError:
            return False
        if message.get("values"):
            return True


def main() -> None:
    """Replay, evaluate and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("recordings", type=Path)
    parser.add_argument("model", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--split", type=Path, required=True)
    parser.add_argument("--alarms-on", type=Path, required=True)
    parser.add_argument("--trials", type=int, default=6)
    parser.add_argument("--per-hour", type=float, default=60.0)
    parser.add_argument("--realtime", action="store_true")
    chosen = parser.parse_args()
    chosen.output.mkdir(parents=True, exist_ok=True)
    if chosen.realtime:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    recordings = tacpipe.open(chosen.recordings)
    segments = tacpipe.open(chosen.alarms_on).select(split=str(chosen.split), role="test")
    for name in sorted(segments.recordings)[: chosen.trials]:
        recording = recordings[name]
        replayed(chosen.output, chosen.model, name, {one: recording.table(one) for one in STREAMS}, chosen)
    results = chosen.output / "results"
    words = ["evaluate", str(chosen.model), str(chosen.output / "live"), "--live", "-o", str(results), "--replace"]
    subprocess.run([sys.executable, "-m", "tacpipe", *words], check=True)
    print((results / "live.csv").read_text())
    live = json.loads((results / "metrics.json").read_text())["live"]
    print(json.dumps({name: live[name] for name in ("rows", "latency", "alarms")}, indent=1))


if __name__ == "__main__":
    main()
