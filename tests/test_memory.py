"""Too little memory is one sentence: no traceback, no abort, and never called damage or a bad recording."""

import errno
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tacpipe.errors import DamagedError, ShortageError, TacpipeError
from tacpipe.io import memory
from tacpipe.io.parquet import from_parquet, to_parquet
from tests.conftest import Lab, write_source


@pytest.mark.parametrize(
    ("error", "short"),
    [
        (MemoryError(), True),
        (pa.ArrowMemoryError("malloc of size 65536 failed"), True),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), True),
        (OSError(errno.EAGAIN, "Resource temporarily unavailable"), True),
        (ImportError("libarrow.so: failed to map segment from shared object"), True),
        (RuntimeError("can't start new thread"), True),
        (RuntimeError("[enforce fail at alloc_cpu.cpp] DefaultCPUAllocator: can't allocate memory"), True),
        (OSError(errno.EIO, "Input/output error"), False),
        (ImportError("No module named torch"), False),
        (RuntimeError("shapes do not match"), False),
        (ValueError("a mistake"), False),
    ],
)
def test_what_libraries_raise_for_lack_of_memory_is_known_also_as_a_cause(error: Exception, short: bool) -> None:
    assert (memory.shortage(error) is not None) is short
    try:
        raise KeyError("of whoever called it") from error
    except KeyError as outer:
        assert (memory.shortage(outer) is not None) is short


@pytest.mark.parametrize(
    "failure", [pa.ArrowMemoryError("malloc of size 65536 failed"), OSError("ZSTD_DCtx create failed")]
)
def test_a_table_that_memory_does_not_hold_is_not_called_damaged(
    monkeypatch: pytest.MonkeyPatch, leave_memory: Callable[[int], None], failure: Exception
) -> None:
    content = to_parquet(pa.table({"x": np.arange(10)}))

    def fail(*_: Any, **__: Any) -> None:
        raise failure

    monkeypatch.setattr(pq.ParquetFile, "read", fail)
    leave_memory(1 << 20)
    with pytest.raises(ShortageError, match="needs more memory than there is"):
        from_parquet(content)
    leave_memory(1 << 40)
    with pytest.raises(DamagedError):
        from_parquet(content)


def test_a_recording_that_memory_does_not_hold_is_no_bad_recording(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    write_source("raw", a="1\n2\n", b="1\n2\n")
    real = Path.read_text

    def read_text(path: Path, *arguments: Any, **options: Any) -> str:
        if path.name == "b.txt":
            raise MemoryError
        return real(path, *arguments, **options)

    monkeypatch.setattr(Path, "read_text", read_text)
    ran = lab.call("ingest numbers raw -o data/r --skip-bad")
    assert ran.code == 1
    assert "This command needs more memory than there is" in ran.err
    assert "Traceback" not in ran.err
    assert not (lab.folder / "data").exists()


@pytest.mark.parametrize("megabytes", [60, 150, 400])
@pytest.mark.parametrize("command", ["show data/r", "scale data/r -o data/s --jobs 2"])
def test_a_limit_of_address_space_is_answered_by_one_sentence(lab: Lab, command: str, megabytes: int) -> None:
    lab.run("simulate toy -o data/r --trials 9")
    ran = subprocess.run(
        [sys.executable, "-m", "tacpipe", *command.split()],
        cwd=lab.folder,
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (megabytes << 20, megabytes << 20)),
    )
    assert ran.returncode == 1, ran.stderr
    (line,) = ran.stderr.splitlines()
    assert line.startswith("tacpipe: This command needs more memory than there is: ")
    assert line.endswith("run the same command again with more, or with a smaller --jobs.")


def test_a_limit_is_named_and_a_library_without_room_is_not_loaded(
    monkeypatch: pytest.MonkeyPatch, leave_memory: Callable[[int], None]
) -> None:
    leave_memory(100 << 20)
    memory.require_library("torch")  # there is no limit: the computer may swap
    monkeypatch.setattr(resource, "getrlimit", lambda _: (512_000_000, 512_000_000))
    with pytest.raises(
        TacpipeError, match=r"torch takes .* MB to load; 105 MB are left, of the 512 MB that `ulimit -v`"
    ):
        memory.require_library("torch")


def test_a_sound_recording_that_is_larger_than_what_is_left_is_not_called_damaged(
    lab: Lab, leave_memory: Callable[[int], None]
) -> None:
    content = to_parquet(pa.table({"x": np.arange(20_000_000)}))
    leave_memory(1 << 27)
    with pytest.raises(ShortageError, match=r"declares 0\.2 GB of data, and 0\.1 GB of memory are left"):
        from_parquet(content)


@pytest.mark.parametrize(
    ("line", "place", "files"),
    [
        ("0::/lab/job", "lab", {"memory.max": "5000", "memory.current": "3000", "memory.stat": "inactive_file 500"}),
        (
            "4:cpu,memory:/lab/job",
            "memory/lab",
            {
                "memory.limit_in_bytes": "5000",
                "memory.usage_in_bytes": "3000",
                "memory.stat": "total_inactive_file 500",
            },
        ),
    ],
)
def test_the_limit_of_a_control_group_above_counts_in_both_versions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str, place: str, files: dict[str, str]
) -> None:
    (tmp_path / place).mkdir(parents=True)
    for name, text in files.items():
        (tmp_path / place / name).write_text(text)
    (tmp_path / "own").write_text(line + "\n")
    monkeypatch.setattr(memory, "GROUPS", tmp_path)
    monkeypatch.setattr(memory, "OWN_GROUPS", tmp_path / "own")
    assert memory.available() == 5000 - 3000 + 500


def test_blocks_of_bounded_memory_that_overlap_leave_no_limit_behind() -> None:
    before = resource.getrlimit(resource.RLIMIT_DATA)
    first, second = memory.bounded(1 << 30, "a"), memory.bounded(1 << 29, "b")
    first.__enter__()
    second.__enter__()
    assert resource.getrlimit(resource.RLIMIT_DATA)[0] != before[0]
    first.__exit__(None, None, None)
    second.__exit__(None, None, None)
    assert resource.getrlimit(resource.RLIMIT_DATA) == before
