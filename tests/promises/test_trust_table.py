"""Test that tacpipe withstands the faults that are also applied to DVC and joblib."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.test_dvc import NEEDS_DVC

PROJECT = Path(__file__).parents[2]


@pytest.mark.faults
@pytest.mark.dvc
@NEEDS_DVC
@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="processes are told apart by /proc")
def test_tacpipe_holds_under_each_fault_that_is_done_to_dvc_and_joblib_too() -> None:
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(("GIT_", "DVC_", "TACPIPE_"))}
    process = subprocess.run(
        [sys.executable, "-m", "tests.promises.trust.table", "--json"],
        cwd=PROJECT,
        env=inherited,
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.stdout, process.stderr
    table = json.loads(process.stdout)
    assert len(table) == 11
    assert all(set(row) == {"tacpipe", "dvc repro", "joblib.Memory"} for row in table.values())
    failed = {fault: row["tacpipe"][0] for fault, row in table.items() if row["tacpipe"][1] is False}
    assert failed == {}
    assert process.returncode == 0
    other_tools = [row[tool][1] for row in table.values() for tool in ("dvc repro", "joblib.Memory")]
    assert False in other_tools, "a table in which nothing ever fails has looked at nothing"
