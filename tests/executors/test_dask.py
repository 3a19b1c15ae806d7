"""Test Dask workers: connection, required versions, and recovery after a worker dies."""

import signal
import time
from dataclasses import replace
from typing import Any

import pytest

from tacpipe.engine.executors import dask
from tacpipe.engine.keys import WorkerTask, identity
from tests.conftest import Lab
from tests.executors.conftest import GIVE_UP_S, Apart
from tests.executors.test_ends import records, start_command, wait_for_one_more

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("dask://10.0.0.7:8786", "tls://10.0.0.7:8786"),
        ("dask://cluster.example:8786", "tls://cluster.example:8786"),
        ("tls", "tls://"),
        ("tls://127.0.0.1:1", "ca-file"),
        ("dask://[::1]:x", "as localhost:8786"),
        ("dask://127.0.0.1:99999", "as localhost:8786"),
        ("local://8786", "8786"),
        ("ray", "dask, local, slurm, tls"),
    ],
)
def test_a_scheduler_that_must_not_or_cannot_be_reached_is_refused(lab: Lab, address: str, words: str) -> None:
    lab.run("simulate toy -o data/rec --jobs 1")
    ran = lab.call(f"scale data/rec -o data/out --executor {address}")
    assert ran.code == 2
    assert words in ran.err and len(ran.err.splitlines()) == 1


def test_a_scheduler_that_does_not_answer_is_named(lab: Apart, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed", reason="the extra dask is not installed")
    monkeypatch.setattr(dask, "_CONNECT_S", 0.2)
    lab.run("simulate toy -o data/rec --jobs 1")
    ran = lab.inside("scale data/rec -o data/out --executor dask://127.0.0.1:1")
    assert ran.code == 1
    assert "127.0.0.1:1" in ran.err
    assert "Traceback" not in ran.err


@pytest.mark.long
def test_a_record_names_the_worker(lab: Lab, scheduler: str) -> None:
    lab.run("simulate toy -o data/rec --jobs 1")
    lab.run(f"scale data/rec -o data/out --executor {scheduler}")
    scaled = [record["provenance"] for _, record in lab.store.records() if record["identity"].get("stage") == "scale"]
    assert [provenance["worker"] for provenance in scaled] and all(provenance["worker"] != "" for provenance in scaled)
    simulated = [
        record["provenance"] for _, record in lab.store.records() if record["identity"].get("stage") == "simulate.toy"
    ]
    assert not any("worker" in provenance for provenance in simulated)


@pytest.mark.long
def test_a_worker_with_other_versions_is_refused_in_one_sentence(
    lab: Apart, scheduler: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab.run("simulate toy -o data/rec --jobs 1")
    versions = dask.local_versions
    monkeypatch.setattr(dask, "local_versions", lambda stage: {**versions(stage), "numpy": "0.1"})
    ran = lab.inside(f"scale data/rec -o data/out --executor {scheduler}")
    assert ran.code == 2
    assert "(here 0.1)" in ran.err
    assert "Traceback" not in ran.err


@pytest.mark.long
def test_a_worker_that_sees_another_store_is_refused(
    lab: Apart, scheduler: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab.run("simulate toy -o data/rec --jobs 1")
    absolute = dask._absolute
    monkeypatch.setattr(dask, "_absolute", lambda task: replace(absolute(task), run=f"{task.run}-of-another"))
    ran = lab.inside(f"scale data/rec -o data/out --executor {scheduler}")
    assert ran.code == 1
    assert str(lab.folder) in ran.err


@pytest.mark.long
def test_a_collection_beside_a_worker_takes_nothing_that_it_made(lab: Lab, scheduler: str) -> None:
    """The worker's own lease announces what it makes; the command's lease, what it has heard of."""
    lab.run("simulate toy -o data/rec --trials 3 --jobs 1")
    command = start_command(lab, f"scale data/rec -o data/out --executor {scheduler}")
    announced: set[str] = set()
    while command.poll() is None:  # the worker's lease may end right after the command does
        announced |= {digest for run in lab.store.leases.runs() for digest in run.objects}
        time.sleep(0.005)
    assert command.returncode == 0
    assert {digest for digest, _ in lab.manifest("data/out").sizes()} <= announced


def test_tasks_are_named_by_absolute_paths() -> None:
    task = WorkerTask("store", "ingest.numbers", identity("ingest.numbers", 1, {}, {}), files={"a": "raw/a.txt"})
    files = dask._absolute(task).files
    assert files is not None and files["a"].startswith("/") and files["a"].endswith("raw/a.txt")


@pytest.mark.long
def test_what_a_killed_worker_left_another_one_computes(lab: Lab, cluster: Any) -> None:
    lab.run("simulate toy -o data/rec --trials 6 --jobs 1")
    lab.run("scale data/rec -o data/one --jobs 1")
    expected = lab.manifest("data/one").content
    cluster.work("first")
    cluster.work("second")
    import threading

    killer = threading.Timer(1.0, cluster.workers["first"].send_signal, [signal.SIGKILL])
    killer.start()
    lab.run(f"scale data/rec -o data/other --factor 2 --rerun --pause-s 0.7 --executor {cluster.executor}")
    killer.join()
    assert cluster.workers["first"].wait() == -signal.SIGKILL
    shards = {name: entry["shards"] for name, entry in lab.manifest("data/other").recordings.items()}
    assert shards == {name: entry["shards"] for name, entry in lab.manifest("data/one").recordings.items()}
    assert expected  # the params differ, the shards do not


@pytest.mark.long
def test_a_scheduler_that_ends_is_reported_and_what_was_finished_is_kept(lab: Lab, cluster: Any) -> None:
    lab.run("simulate toy -o data/rec --trials 6 --jobs 1")
    cluster.work("only")
    before = records(lab)
    command = start_command(lab, f"scale data/rec -o data/out --pause-s 0.7 --executor {cluster.executor}")
    wait_for_one_more(lab, before)
    cluster.scheduler.send_signal(signal.SIGKILL)
    _, printed = command.communicate(timeout=GIVE_UP_S)
    assert command.returncode == 1
    assert cluster.address in printed
    assert "Traceback" not in printed
    local_run = lab.run("scale data/rec -o data/out --pause-s 0.7 --jobs 1")
    assert " 0 reused" not in local_run.err


@pytest.mark.long
def test_a_scheduler_without_workers_is_refused(lab: Lab, cluster: Any) -> None:
    lab.run("simulate toy -o data/rec --jobs 1")
    ran = lab.call(f"scale data/rec -o data/out --executor {cluster.executor}")
    assert ran.code == 1
    assert "dask worker" in ran.err


@pytest.mark.long
def test_workers_are_started_for_one_command_and_end_with_it(lab: Lab) -> None:
    pytest.importorskip("distributed", reason="the extra dask is not installed")
    lab.run("simulate toy -o data/rec --trials 4 --jobs 1")
    lab.run("scale data/rec -o data/out --executor dask --jobs 2")
    workers = {
        record["provenance"].get("worker")
        for _, record in lab.store.records()
        if record["identity"].get("stage") == "scale"
    }
    assert workers == {"0", "1"} or len(workers) == 1
