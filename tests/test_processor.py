"""A record states the processor and the threads that computed it."""

import os
import subprocess
from pathlib import Path

import pytest

from tacpipe.engine import provenance
from tacpipe.errors import UsageError
from tacpipe.store.records import Provenance
from tests.conftest import run_python

CPUINFO = """processor\t: 0
model name\t: Zen 4
flags\t\t: fpu avx avx2 fma avx512f rdpid

processor\t: 1
model name\t: another
"""


@pytest.fixture(autouse=True)
def _forget() -> None:
    provenance._processor.cache_clear()


def test_the_first_core_says_model_and_instructions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "cpuinfo").write_text(CPUINFO)
    monkeypatch.setattr(provenance, "_CPUINFO", tmp_path / "cpuinfo")
    monkeypatch.setenv("OPENBLAS_CORETYPE", "Haswell")
    described = provenance.describe_processor()
    assert described["model"] == "Zen 4" and described["instructions"] == ["avx", "avx2", "fma", "avx512f"]
    assert described["chosen"] == {"OPENBLAS_CORETYPE": "Haswell"}


def test_without_a_list_of_cores_the_machine_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(provenance, "_CPUINFO", tmp_path / "none")
    assert provenance.describe_processor()["model"] and provenance.describe_processor()["instructions"] == []


@pytest.mark.long
@pytest.mark.parametrize("threads", [1, 2])
def test_threads_are_those_that_torch_and_blas_use(threads: int) -> None:
    program = (
        "from tacpipe.engine import provenance; before = provenance.threads(); import torch;"
        "print(before, provenance.threads())"
    )
    ran = run_python(Path(), "-c", program, environment={"OMP_NUM_THREADS": str(threads)}, check=True)
    assert ran.stdout.split() == [str(threads)] * 2


@pytest.mark.parametrize("variables", [{}, {"OMP_WAIT_POLICY": "ACTIVE"}])
def test_threads_that_wait_sleep_unless_the_environment_states_otherwise(variables: dict[str, str]) -> None:
    program = "import os, sys, tacpipe.engine.pipeline; print(os.environ['OMP_WAIT_POLICY'], 'torch' in sys.modules)"
    ran = run_python(Path(), "-c", program, environment=variables, check=True)
    assert ran.stdout.split() == [variables.get("OMP_WAIT_POLICY", "PASSIVE"), "False"]


def test_computers_differ_in_processor_threads_device_and_libraries() -> None:
    stored = provenance.describe_provenance(1.0)
    assert provenance.environment_differences(stored, provenance.describe_provenance(2.0)) == []
    other_computer: Provenance = {
        **stored,
        "device": "cuda",
        "processor": {**stored["processor"], "instructions": ["sve"], "threads": 977},
    }
    differences = provenance.environment_differences(other_computer, stored)
    assert [difference.partition(":")[0] for difference in differences] == ["device", "instructions", "threads"]
    assert differences[0] == f"device: cuda, now {stored['device']}"


def test_a_git_that_does_not_answer_leaves_the_commit_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def hangs(*_: object, **__: object) -> None:
        raise subprocess.TimeoutExpired("git", 5)

    monkeypatch.setattr(subprocess, "run", hangs)
    provenance._environment.cache_clear()
    assert provenance.describe_provenance(0.0)["git_commit"] is None
    provenance._environment.cache_clear()


def test_a_record_that_does_not_say_is_unlike_nothing() -> None:
    assert provenance.environment_differences({}, provenance.describe_provenance(0.0)) == []


def test_each_of_several_processes_gets_its_part_of_the_cores_unless_the_environment_states_threads(
    eight_cores: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = [{name: os.environ.get(name)} for name in provenance.THREADS]
    assert provenance.each_of(2) == dict.fromkeys(provenance.THREADS, "4")
    assert provenance.each_of(16) == dict.fromkeys(provenance.THREADS, "1")
    with provenance.shared_by(3):
        assert [os.environ[name] for name in provenance.THREADS] == ["2", "2", "2"]
    assert [{name: os.environ.get(name)} for name in provenance.THREADS] == before

    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert provenance.each_of(2) == {}


def test_a_command_starts_as_many_processes_as_the_environment_states_else_one_a_core(
    eight_cores: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert provenance.jobs() == 8

    monkeypatch.setenv(provenance.JOBS, "3")
    assert provenance.jobs() == 3


@pytest.mark.parametrize("jobs", ["0", "-1", "two", "1.5"])
def test_a_number_of_processes_that_is_none_is_refused(jobs: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(provenance.JOBS, jobs)
    with pytest.raises(UsageError, match=f"TACPIPE_JOBS is '{jobs}'"):
        provenance.jobs()
