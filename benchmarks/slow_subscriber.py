"""How old messages are when a slow subscriber handles them.

    python -m benchmarks.slow_subscriber [--seconds 24] [--rate-hz 98] [--handling-ms 40] [--max-age-ms 100]

A server publishes slip messages at ``--rate-hz``, each made from a sample that arrives at that moment. A client in a process
of its own needs ``--handling-ms`` for each message. ``plain`` is a client of the library websockets that only listens, and
``subscribe`` is `tacpipe.subscribe`. Ages are measured when the client begins to handle a message. Both processes read one
clock.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from typing import Any

import numpy as np

import tacpipe

CLIENTS = ("plain", "subscribe")
ROWS = 8  # rows of the table


def publish(rate_hz: float, seconds: float, client: list[str]) -> list[list[float]]:
    """Return the rows (time in s, age in ms, missed) that a client prints while a server publishes."""
    from tacpipe.live.preparation import free_ports
    from tacpipe.live.websocket import WebsocketPublisher
    from tacpipe.tasks.slip.live.messages import SlipDescription, SlipMessage

    (port,) = free_ports(1)
    publisher = WebsocketPublisher(f"127.0.0.1:{port}", SlipDescription("model", rate_hz, 1.0, "1", {}))
    words = [sys.executable, "-m", "benchmarks.slow_subscriber", *client, "--port", str(port)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        while not publisher.subscribers:
            time.sleep(0.01)
        began_s = time.monotonic()
        count = 0
        while (elapsed_s := time.monotonic() - began_s) < seconds:
            count += 1
            now_ns = time.time_ns()
            publisher.publish(SlipMessage(count, now_ns, 0.5, 0.5, 0, {"left": [0.0] * 16}, made_from_t_ns=now_ns))
            time.sleep(max(0.0, count / rate_hz - elapsed_s))
        process.kill()
        printed = process.communicate()[0]
    publisher.close()
    return [json.loads(line) for line in printed.splitlines()]


def plain(port: int, handling_s: float) -> None:
    """Print time, age and missed messages for each message that a client of websockets handles."""
    from websockets.sync.client import connect

    began_ns = time.time_ns()
    with connect(f"ws://127.0.0.1:{port}", max_size=None) as session:
        session.recv()
        last, missed = None, 0
        while True:
            message: dict[str, Any] = json.loads(session.recv())
            missed += 0 if last is None else message["seq"] - last - 1
            last = message["seq"]
            show(began_ns, message["t_ns"], missed)
            time.sleep(handling_s)


def subscribe(port: int, handling_s: float, max_age_ms: float) -> None:
    """Print the same for each message of `tacpipe.subscribe`."""
    began_ns = time.time_ns()
    for message in tacpipe.subscribe(f"ws://127.0.0.1:{port}", max_age_ms):
        if message["kind"] != "unknown":
            show(began_ns, message["t_ns"], message["missed"])
        time.sleep(handling_s)


def show(began_ns: int, sampled_ns: int, missed: int) -> None:
    """Print the age of a message."""
    now_ns = time.time_ns()
    print(json.dumps([(now_ns - began_ns) / 1e9, (now_ns - sampled_ns) / 1e6, missed]), flush=True)


def main() -> None:
    """Run the clients and print a table of ages."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seconds", type=float, default=24.0)
    parser.add_argument("--rate-hz", type=float, default=98.0)
    parser.add_argument("--handling-ms", type=float, default=40.0)
    parser.add_argument("--max-age-ms", type=float, default=100.0)
    parser.add_argument("--client", choices=CLIENTS)
    parser.add_argument("--port", type=int)
    chosen = parser.parse_args()
    if chosen.port and chosen.client == "plain":
        plain(chosen.port, chosen.handling_ms / 1e3)
    elif chosen.port:
        subscribe(chosen.port, chosen.handling_ms / 1e3, chosen.max_age_ms)
    names = [chosen.client] if chosen.client else CLIENTS
    print(
        "| client | age in ms at "
        + " | ".join(f"{share * chosen.seconds / ROWS:.0f} s" for share in range(1, ROWS + 1))
    )
    for name in names:
        options = ["--client", name, "--handling-ms", str(chosen.handling_ms), "--max-age-ms", str(chosen.max_age_ms)]
        rows = np.array(publish(chosen.rate_hz, chosen.seconds, options))
        ages = []
        for share in range(1, ROWS + 1):
            until_s = share * chosen.seconds / ROWS
            ages.append(rows[rows[:, 0] <= until_s][-1, 1])
        cells = " | ".join(f"{age:.0f}" for age in ages)
        print(
            f"| {name} | {cells} | handled {len(rows)}, missed {rows[-1, 2]:.0f}, largest age {rows[:, 1].max():.0f} ms |"
        )


if __name__ == "__main__":
    main()
