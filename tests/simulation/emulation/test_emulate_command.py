"""The command that emulates a rig."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from tacpipe.links.opening import open_link
from tacpipe.recording import rig
from tests.simulation.emulation.rigs import FOLDER, awaited

pytestmark = pytest.mark.rig

COMMAND = [sys.executable, "-m", "tacpipe", "sensors", "emulate"]


def test_a_rig_is_served_until_it_is_stopped_and_the_ledger_is_left(tmp_path: Path) -> None:
    with subprocess.Popen(
        [*COMMAND, str(FOLDER / "first-paper.toml"), "-o", str(tmp_path), "--faults", "drop=0.1"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None and process.stderr is not None
        assert process.stdout.readline().strip() == str(tmp_path / "rig.toml")
        stream = rig.read(tmp_path / "rig.toml").streams["proximity"]
        link = open_link(stream.address, stream.sensor, "proximity")
        awaited(lambda: link.read(0.2))
        link.read(0.5)
        link.close()
        process.send_signal(signal.SIGINT)
        output = process.stderr.read()
        assert process.wait() == 0
    assert "proximity: generic at serial:" in output
    assert "robot: nobody listened" in output
    table = pq.read_table(tmp_path / "ledger" / "proximity.parquet")
    assert {"sent_ns", "number", "cause"} <= set(table.column_names)
    summary = json.loads((tmp_path / "ledger" / "proximity.json").read_text())
    assert summary["counts"]["sent"] > 0
    assert [event["what"] for event in summary["events"]] == ["connected"]


def test_an_unknown_fault_is_a_usage_error(tmp_path: Path) -> None:
    process = subprocess.run(
        [*COMMAND, str(FOLDER / "first-paper.toml"), "-o", str(tmp_path), "--faults", "gremlins=1"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.returncode == 2
    assert "there is no fault gremlins" in process.stderr
    assert "Traceback" not in process.stderr
