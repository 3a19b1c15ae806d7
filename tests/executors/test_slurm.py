"""Test Slurm jobs: their submission, the error of a job that cannot work, and that no job is left behind."""

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

from tests.conftest import Lab
from tests.executors.conftest import GIVE_UP_S, Apart
from tests.executors.test_ends import SLOW, records, start_command, wait_for_one_more

TRIALS = 12


def jobs(state: str = "") -> list[str]:
    """Return the numbers of the jobs that wait or run, or that are in a ``state``."""
    command = ["squeue", "--noheader", "--format=%i", *([f"--states={state}"] if state else [])]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()


def wait_until_no_job_is_left() -> None:
    began_s = time.monotonic()
    while jobs():
        assert time.monotonic() - began_s < GIVE_UP_S
        time.sleep(0.2)


def test_a_computer_without_slurm_is_refused(lab: Apart, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip("dask_jobqueue", reason="the extra slurm is not installed")
    lab.run("simulate toy -o data/rec --jobs 1")
    monkeypatch.setenv("PATH", str(tmp_path))
    ran = lab.call("scale data/rec -o data/out --executor slurm")
    assert ran.code == 1
    assert "sbatch" in ran.err
    assert "Traceback" not in ran.err


@pytest.mark.long
@pytest.mark.usefixtures("slurm")
class TestJobs:
    """Tests that need a running Slurm."""

    def test_each_result_names_its_job_and_no_job_is_left(self, lab: Lab) -> None:
        lab.run(f"simulate toy -o data/rec --trials {TRIALS} --jobs 1")
        lab.run("scale data/rec -o data/one --jobs 1")
        lab.run("scale data/rec -o data/out --factor 2 --pause-s 0.1 --executor slurm --jobs 2")
        workers = {
            record["provenance"]["worker"]
            for _, record in lab.store.records()
            if "worker" in record["provenance"] and record["identity"].get("stage") == "scale"
        }
        assert 1 <= len(workers) <= 2
        wait_until_no_job_is_left()

    def test_a_job_computes_with_as_many_threads_as_it_has_cores(
        self, lab: Lab, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        lab.run("simulate toy -o data/rec --jobs 1")
        monkeypatch.setenv("DASK_JOBQUEUE__SLURM__CORES", "2")
        lab.run("scale data/rec -o data/out --executor slurm --jobs 1")
        threads = {
            record["provenance"]["processor"]["threads"]
            for _, record in lab.store.records()
            if record["identity"].get("stage") == "scale"
        }
        assert threads == {2}

    def test_an_unknown_partition_is_named(self, lab: Lab) -> None:
        lab.run("simulate toy -o data/rec --jobs 1")
        ran = lab.call("scale data/rec -o data/out --executor slurm://none-such --jobs 1")
        assert ran.code == 1
        assert "none-such" in ran.err
        assert "Traceback" not in ran.err

    def test_what_a_job_requests_comes_from_the_configuration_of_dask(
        self, lab: Lab, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        lab.run("simulate toy -o data/rec --jobs 1")
        monkeypatch.setenv("DASK_JOBQUEUE__SLURM__ACCOUNT", "lab")
        monkeypatch.setenv("DASK_JOBQUEUE__SLURM__CORES", "3")
        monkeypatch.setenv("DASK_JOBQUEUE__SLURM__JOB_EXTRA_DIRECTIVES", "['--hold']")
        command = start_command(lab, f"{SLOW} --executor slurm --jobs 1")
        began_s = time.monotonic()
        while not (pending := jobs("PENDING")):
            assert time.monotonic() - began_s < GIVE_UP_S
            time.sleep(0.2)
        job_description = subprocess.run(
            ["scontrol", "show", "job", pending[0]], check=True, capture_output=True, text=True
        ).stdout
        command.send_signal(signal.SIGINT)
        _, printed = command.communicate(timeout=GIVE_UP_S)
        assert "Account=lab" in job_description
        assert "NumCPUs=3" in job_description
        assert command.returncode == 130
        assert "Traceback" not in printed
        wait_until_no_job_is_left()

    def test_jobs_that_cannot_start_python_end_the_command_with_what_they_printed(
        self, lab: Lab, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        lab.run("simulate toy -o data/rec --jobs 1")
        monkeypatch.setenv("DASK_JOBQUEUE__SLURM__PYTHON", "/none/such/python")
        ran = lab.call("scale data/rec -o data/out --executor slurm --jobs 1")
        assert ran.code == 1
        assert "/none/such/python" in ran.err
        assert not jobs()

    def test_what_a_cancelled_job_left_another_one_computes(self, lab: Lab) -> None:
        lab.run(f"simulate toy -o data/rec --trials {TRIALS} --jobs 1")
        before = records(lab)
        command = start_command(lab, f"{SLOW} --executor slurm --jobs 2")
        wait_for_one_more(lab, before)
        subprocess.run(["scancel", jobs("RUNNING")[0]], check=True)
        _, printed = command.communicate(timeout=GIVE_UP_S)
        assert command.returncode == 0, printed
        assert len(lab.manifest("data/out").recordings) == TRIALS

    def test_ctrl_c_cancels_the_jobs(self, lab: Lab) -> None:
        lab.run(f"simulate toy -o data/rec --trials {TRIALS} --jobs 1")
        before = records(lab)
        command = start_command(lab, f"{SLOW} --executor slurm --jobs 1")
        wait_for_one_more(lab, before)
        command.send_signal(signal.SIGINT)
        _, printed = command.communicate(timeout=GIVE_UP_S)
        assert command.returncode == 130
        assert "Traceback" not in printed
        wait_until_no_job_is_left()

    def test_certificates_and_logs_are_gone_after_the_command(self, lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
        lab.run("simulate toy -o data/rec --jobs 1")
        shared = lab.folder / "shared"
        monkeypatch.setenv("DASK_JOBQUEUE__SLURM__SHARED_TEMP_DIRECTORY", str(shared))
        lab.run("scale data/rec -o data/out --executor slurm --jobs 1")
        assert os.listdir(shared) == []  # noqa: PTH208
