"""A signal that ends a process of these tests is named, with the test that it met."""

import signal
from pathlib import Path

import pytest

from tests.conftest import run_python


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGALRM, signal.SIGIO])
def test_a_signal_that_ends_pytest_is_named_before_it_does(number: signal.Signals) -> None:
    program = f"import os\nfrom tests import conftest\nconftest.name_signals()\nos.kill(os.getpid(), {int(number)})"
    environment = {"PYTEST_CURRENT_TEST": "test_x (call)"}
    process = run_python(Path(__file__).parents[1], "-c", program, environment=environment)

    assert process.returncode == -number
    assert f"of pytest ends by {number.name} in test_x (call):" in process.stderr
