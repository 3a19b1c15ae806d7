"""A signal that ends a process of these tests is named, with the test that it met."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGALRM, signal.SIGIO])
def test_a_signal_that_ends_pytest_is_named_before_it_does(number: signal.Signals) -> None:
    program = f"import os\nfrom tests import conftest\nconftest.name_signals()\nos.kill(os.getpid(), {int(number)})"
    process = subprocess.run(
        [sys.executable, "-c", program],
        cwd=Path(__file__).parents[1],
        env={**os.environ, "PYTEST_CURRENT_TEST": "test_x (call)"},
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )

    assert process.returncode == -number
    assert f"of pytest ends by {number.name} in test_x (call):" in process.stderr
