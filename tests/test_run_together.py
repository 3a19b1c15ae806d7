"""`tacpipe run --jobs`: several stages at a time give what they give one after another."""

import os
import signal
import subprocess
import sys
import time
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest

from tests.conftest import Lab, tacpipe
from tests.test_run import STAGES, content, stage_that_adds, write_chain

WAITS = "for i in $(seq 3000); do [ -e {} ] && break; sleep 0.02; done; [ -e {} ]"  # waits for another stage's file


def test_several_stages_at_a_time_give_the_bytes_that_they_give_one_after_another(lab: Lab, tmp_path: Path) -> None:
    scaled = {f"scaled-{factor}": _scale_stage(factor) for factor in (2, 3, 4)}
    write_chain({"toy": STAGES["toy"], **scaled})
    lab.run("run dvc.yaml --jobs 2")
    separate = tmp_path / "alone"
    (separate / ".tacpipe").mkdir(parents=True)
    write_chain({"toy": STAGES["toy"], **scaled}, separate)

    assert tacpipe(separate, "run dvc.yaml").returncode == 0
    assert len(content(separate)) > 8 and content(lab.folder) == content(separate)


def test_stages_that_do_not_depend_on_each_other_run_at_the_same_time(lab: Lab) -> None:
    write_chain(
        {
            "first": {"cmd": f"touch first && {WAITS.format('second', 'second')}"},
            "second": {"cmd": f"touch second && {WAITS.format('first', 'first')}"},
        }
    )

    assert lab.run("run dvc.yaml --jobs 2").err.splitlines()[-1] == "2 ran"


def test_no_more_than_the_asked_number_run_at_the_same_time(lab: Lab) -> None:
    command = "mkdir {n} && ls -d at-* | wc -l >> counts; sleep 0.1; rmdir {n}"
    write_chain({str(number): {"cmd": command.format(n=f"at-{number}")} for number in range(6)})
    lab.run("run dvc.yaml --jobs 2")

    assert set(Path("counts").read_text().split()) <= {"1", "2"}


def test_a_failing_stage_keeps_back_what_depends_on_it_and_nothing_else_of_several_at_a_time(lab: Lab) -> None:
    scaled = {**STAGES["scaled"], "cmd": "tacpipe scale data/toy -o data/scaled --factor many"}
    write_chain(
        {
            **STAGES,
            "scaled": scaled,
            "other": stage_that_adds("other"),
            "frozen": {**stage_that_adds("frozen"), "frozen": True},
        }
    )
    failed = lab.call("run dvc.yaml --jobs 2")

    assert failed.code == 2
    assert Path("data/toy/manifest.json").exists() and Path("ran").read_text() == "other\n"
    assert not Path("data/scaled").exists() and not Path("total").exists()
    assert "factor" in failed.err and "total was not run" in failed.err
    assert failed.err.splitlines()[-1] == "1 unchanged, 2 ran, 1 failed, 1 not run"


def test_what_stages_print_is_kept_apart_whatever_their_names(lab: Lab) -> None:
    names = ["a/b", "a_b", "l" * 300]
    write_chain({name: {"cmd": f"echo {number}; sleep 0.2; echo {number}"} for number, name in enumerate(names)})

    assert sorted(lab.run("run dvc.yaml --jobs 3").out.splitlines()) == sorted("001122")


def test_the_commands_of_a_stage_follow_each_other_and_what_they_print_is_printed_as_a_whole(lab: Lab) -> None:
    slow = "for i in 1 2 3; do echo {n}; echo {n} >&2; sleep 0.05; done"
    write_chain({name: {"cmd": [slow.format(n=f"{name}1"), slow.format(n=f"{name}2")]} for name in ("a", "b")})
    ran = lab.run("run dvc.yaml --jobs 2")

    lines = ran.out.split()
    assert sorted(lines) == sorted(f"{name}{number}" for name in "ab" for number in "12" for _ in range(3))
    assert all(len(set(lines[first : first + 3])) == 1 for first in range(0, 12, 3))
    assert [line for line in lines if line[0] == "a"] == ["a1"] * 3 + ["a2"] * 3
    assert "a1\na1\na1\n" in ran.err


def test_with_nothing_to_do_no_process_is_started(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    write_chain(STAGES)
    lab.run("run dvc.yaml")
    monkeypatch.setattr(BaseProcess, "start", lambda _: pytest.fail("a process was started"))

    assert lab.run("run dvc.yaml --jobs 0").err.splitlines()[-1] == "3 unchanged"


def test_each_process_gets_its_part_of_the_cores(lab: Lab, eight_cores: None) -> None:
    write_chain({str(number): {"cmd": "echo $OMP_NUM_THREADS $OPENBLAS_NUM_THREADS >> threads"} for number in range(2)})
    lab.run("run dvc.yaml --jobs 2")

    assert Path("threads").read_text() == "4 4\n4 4\n"
    assert "OMP_NUM_THREADS" not in os.environ


def test_commands_that_begin_together_share_the_cores_and_one_alone_has_them_all(lab: Lab, eight_cores: None) -> None:
    stages = {name: {"cmd": f"echo $TACPIPE_JOBS > {name}"} for name in ("first", "second", "last")}
    stages["first"]["cmd"] = f"touch a && {WAITS.format('b', 'b')}; echo $TACPIPE_JOBS > first"
    stages["second"]["cmd"] = f"touch b && {WAITS.format('a', 'a')}; echo $TACPIPE_JOBS > second"
    outs: dict[str, dict[str, object]] = {name: {**stage, "outs": [name]} for name, stage in stages.items()}
    write_chain({**outs, "last": {**outs["last"], "deps": ["first", "second"]}})
    lab.run("run dvc.yaml --jobs 4")

    assert [Path(name).read_text() for name in stages] == ["4\n", "4\n", "8\n"]


@pytest.mark.long
def test_an_interrupt_ends_all_stages_at_work(lab: Lab) -> None:
    work = "import os, pathlib, time; pathlib.Path('pid-{n}').write_text(str(os.getpid())); time.sleep(600)"
    write_chain({f"slow-{n}": {"cmd": f'exec {sys.executable} -c "{work.format(n=n)}"'} for n in range(2)})
    command = [sys.executable, "-m", "tacpipe", "run", "dvc.yaml", "--jobs", "2"]
    process = subprocess.Popen(command, env=dict(os.environ), stderr=subprocess.PIPE, text=True)
    places = [Path(f"pid-{n}") for n in range(2)]
    while not all(place.exists() and place.read_text() for place in places):
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=60)

    assert process.returncode == 130
    for place in places:
        _wait_until_gone(int(place.read_text()))


def _wait_until_gone(pid: int) -> None:
    """Wait until no process has this number; fail where one has it for a minute."""
    until_s = time.monotonic() + 60
    while time.monotonic() < until_s:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return
        time.sleep(0.02)
    pytest.fail(f"process {pid} is still there")


def _scale_stage(factor: int) -> dict[str, object]:
    """Return a stage that scales the toy recordings into a folder of its own."""
    place = f"data/scaled-{factor}"
    return {
        "cmd": f"tacpipe scale data/toy -o {place} --factor {factor}",
        "deps": ["data/toy/manifest.json"],
        "outs": [f"{place}/manifest.json"],
    }
