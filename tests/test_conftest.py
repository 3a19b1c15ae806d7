"""Parts of the exhaustive tests: each commit runs another one, and together they are all tests."""

import re
import signal
from pathlib import Path

import pytest

from tests.conftest import left_out, run_python

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("step", [1, 3, 40])
def test_parts_share_no_test_and_leave_none_out(step: int) -> None:
    items = list(range(101))
    parts = [set(items) - left_out(items, f"{first}/{step}") for first in range(1, step + 1)]
    assert sorted(item for part in parts for item in part) == items
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


def test_a_part_without_a_first_begins_with_the_first_test() -> None:
    assert set(range(10)) - left_out(range(10), "4") == {0, 4, 8}


def test_what_ci_samples_begins_with_another_test_at_each_commit() -> None:
    samples = re.findall(r"\$\(\(commits % (\d+) \+ 1\)\)/(\d+)", (ROOT / ".ci/run").read_text())
    assert len(samples) == 1
    for modulo, step in samples:
        assert {commits % int(modulo) + 1 for commits in range(int(step))} == set(range(1, int(step) + 1))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGALRM, signal.SIGIO])
def test_a_signal_that_ends_pytest_is_named_before_it_does(number: signal.Signals) -> None:
    program = f"import os\nfrom tests import conftest\nconftest.name_signals()\nos.kill(os.getpid(), {int(number)})"
    environment = {"PYTEST_CURRENT_TEST": "test_x (call)"}
    process = run_python(Path(__file__).parents[1], "-c", program, environment=environment)

    assert process.returncode == -number
    assert f"of pytest ends by {number.name} in test_x (call):" in process.stderr
