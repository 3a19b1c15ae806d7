"""Inside User-mode Linux, as its first process, run commands on a logged disk or look at disks that lost power.

Each answer is a line, ``RESULT`` and JSON.
"""

import contextlib
import ctypes
import fcntl
import io
import json
import os
import socket
import struct
import subprocess
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tests.recording import counted_device

DISK, LOG, PLACE = "/dev/ubda", "/dev/ubdb", Path("/run/disk")
FINIT_MODULE = 313  # System call of x86-64.
SIOCSIFFLAGS, IFF_UP = 0x8914, 1  # Constants of <linux/sockios.h> and <linux/if.h>.
POWER_OFF = 0x4321FEDC  # Constant of <linux/reboot.h>.
STEPS = {  # mark that is set once the command has returned, and the command
    "ingested": "ingest numbers src -o data/recordings --jobs 1",
    "labelled": "label data/recordings a --set material=foam",
    "scaled": "scale data/recordings -o data/scaled --jobs 1",
    "pushed": "store push remote data/recordings",
    "appended": "ingest numbers more -o data/recordings --jobs 1",
}
ACQUIRE = "acquire rig.toml -o data/acquired --duration-s 2 --name one --quiet"
RECOVER = "acquire --recover -o data/acquired --quiet"
FIRST, MORE = ("a", "b", "c"), ("d",)
libc = ctypes.CDLL(None, use_errno=True)


def values(name: str) -> list[int]:
    """Return what the raw file of a recording holds."""
    return [ord(name) + number for number in range(2000)]


def boot() -> None:
    """Mount what a first process needs."""
    for kind, place in (("proc", "/proc"), ("sysfs", "/sys"), ("devtmpfs", "/dev"), ("tmpfs", "/run")):
        subprocess.run(["mount", "-t", kind, kind, place], check=False, capture_output=True)
    for name in ("disk", "tmp", "home"):
        Path("/run", name).mkdir()
    Path("/dev/pts").mkdir(exist_ok=True)
    subprocess.run(["mount", "-t", "devpts", "devpts", "/dev/pts"], check=False, capture_output=True)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:  # `ip link set lo up`, which not all have
        fcntl.ioctl(any_socket, SIOCSIFFLAGS, struct.pack("16sh14x", b"lo", IFF_UP))
    os.environ |= {"HOME": "/run/home", "TMPDIR": "/run/tmp", "PYTHONDONTWRITEBYTECODE": "1"}
    os.environ |= {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin"}


def load_module(path: str) -> None:
    """Load a module of the kernel."""
    handle = os.open(path, os.O_RDONLY)
    if libc.syscall(FINIT_MODULE, handle, b"", 0):
        raise OSError(ctypes.get_errno(), path)
    os.close(handle)


def run(*words: str) -> None:
    """Run a program that must succeed."""
    ran = subprocess.run(words, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, f"{words}: {ran.stdout} {ran.stderr}"


def tacpipe(command: str, **environment: str) -> tuple[int, str]:
    """Run a command in this process; return its exit code and what it printed."""
    from tacpipe.cli import main as cli

    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        before = dict(os.environ)
        os.environ.update(environment)
        try:
            code = cli.answer(command.split())
        finally:
            os.environ.clear()
            os.environ.update(before)
    return code, printed.getvalue()


def record(kind: str, modules: str) -> dict[str, Any]:
    """Run the steps on a disk whose writes are logged, with a mark after each."""
    for name in ("dm-mod", "dm-log-writes"):
        load_module(f"{modules}/{name}.ko")
    sectors = Path("/sys/block/ubda/size").read_text().strip()
    run("dmsetup", "create", "logged", "--noudevsync", "--table", f"0 {sectors} log-writes {DISK} {LOG}")
    run("mount", "-t", kind, "/dev/dm-0", str(PLACE))
    project = PLACE / "project"
    for folder, names in (("src", FIRST), ("more", MORE)):
        (project / folder).mkdir(parents=True)
        for name in names:
            (project / folder / f"{name}.txt").write_text(" ".join(map(str, values(name))))
    (project / ".tacpipe").mkdir()
    os.sync()
    os.chdir(project)
    mark("prepared")
    for name, command in STEPS.items():
        code, printed = tacpipe(command)
        assert code == 0, printed
        mark(name)
    with device() as terminal:
        Path("rig.toml").write_text(counted_device.WIRE.format(terminal=terminal))
        code, printed = tacpipe(ACQUIRE)
    assert code == 0, printed
    mark("acquired")
    os.sync()
    return {"recorded": kind}


@contextlib.contextmanager
def device() -> Iterator[str]:
    """Yield the terminal of a device that numbers what it sends."""
    words = [sys.executable, "-I", counted_device.__file__, "9"]
    with subprocess.Popen(words, cwd="/run/tmp", stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield json.loads(process.stdout.readline())["terminal"]
        process.kill()


def mark(name: str) -> None:
    """Note in the log that all before was answered."""
    run("dmsetup", "message", "logged", "0", "mark", name)


def check(kind: str, disks: list[list[str]]) -> None:
    """Print a line for each disk: what was wrong there, if anything."""
    for number, passed in enumerate(disks):
        PLACE.with_name(f"disk{number}").mkdir()
        reading, writing = os.pipe()
        child = os.fork()
        if not child:
            disk, place = f"/dev/ubd{chr(ord('a') + number)}", PLACE.with_name(f"disk{number}")
            answer = catch_errors(lambda: check_survival(kind, disk, place, passed))  # noqa: B023
            os.write(writing, json.dumps(answer).encode())
            os._exit(0)
        os.close(writing)
        with os.fdopen(reading, "rb") as pipe:
            answer = json.loads(pipe.read())
        os.waitpid(child, 0)
        with contextlib.suppress(AssertionError):  # it was never mounted
            run("umount", str(PLACE.with_name(f"disk{number}")))
        if kind == "btrfs":  # btrfs refuses a second disk of the same identity, as all replayed ones are.
            run("btrfs", "device", "scan", "--forget")
        print("RESULT", json.dumps({"passed": passed, **answer}), flush=True)


def catch_errors(function: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return what a function returns, or the error that it raised."""
    try:
        return function()
    except BaseException:
        return {"wrong": traceback.format_exc()[-3000:]}


def check_survival(kind: str, disk: str, place: Path, passed: list[str]) -> dict[str, Any]:
    """Look at a disk after a loss of power: what had been answered is there, nothing wrong is served, all can go on."""
    import tacpipe as api
    from tacpipe.errors import TacpipeError

    run("mount", "-t", kind, disk, str(place))  # Mounting replays the file system's journal.
    os.chdir(place / "project")
    if "ingested" in passed:
        names = {*FIRST, *(MORE if "appended" in passed else ())}
        check_recordings(api.open("data/recordings"), names, labelled="labelled" in passed)
    for path in ("data/recordings", "data/scaled"):
        with contextlib.suppress(TacpipeError):
            dataset = api.open(path)
            for name, shard in dataset.recordings.items():
                with contextlib.suppress(TacpipeError):
                    factor = 2 if path == "data/scaled" else 1
                    served = shard.table("left" if factor == 1 else "").column("x").to_pylist()
                    assert served == [factor * value for value in values(name)], f"{path} {name} serves something else"
    code, printed = tacpipe("store verify")
    assert code in (0, 4), printed
    assert code == 0 or "missing" in printed, printed
    if "pushed" in passed:
        code, printed = tacpipe("store verify", TACPIPE_STORE=str(place / "project/remote"))
        assert code == 0, f"the remote: {printed}"
    for command in STEPS.values():
        code, printed = tacpipe(command)
        assert code == 0, f"{command}: {printed}"
    check_recordings(api.open("data/recordings"), {*FIRST, *MORE}, labelled=True)
    check_recovery(passed)
    code, printed = tacpipe("store verify")
    assert code == 0, printed
    return {"wrong": ""}


def check_recovery(passed: list[str]) -> None:
    """Expect each frame that a recording holds once and in order: all of one that had ended, the begin of one cut off."""
    import tacpipe as api

    code, printed = tacpipe(RECOVER)
    assert code == 0, f"{RECOVER}: {printed}"
    if not Path("data/acquired/manifest.json").exists():
        assert "acquired" not in passed, "the recording is gone"
        return
    for recording in api.open("data/acquired").recordings.values():
        table = recording.table("wire")
        numbers = table.column("seq").to_pylist()
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), "frames are missing or out of order"
        assert table.column("value").to_pylist() == [counted_device.value(number) for number in numbers]
        assert len(numbers) > 300 or "acquired" not in passed, f"{len(numbers)} frames of 400"


def check_recordings(dataset: Any, names: set[str], *, labelled: bool) -> None:
    """Expect recordings with all their values, and the label that was set by hand."""
    assert names <= set(dataset.recordings), f"{sorted(dataset.recordings)} of {sorted(names)}"
    for name, shard in dataset.recordings.items():
        assert shard.table("left").column("x").to_pylist() == values(name), name
    if labelled:
        assert dataset.recordings["a"].attributes.get("material") == "foam", dict(dataset.recordings["a"].attributes)


def main() -> None:
    """Do as the file that is named first says, then turn the power off."""
    boot()
    task = json.loads(Path(sys.argv[1]).read_text())
    if "modules" in task:
        print("RESULT", json.dumps(catch_errors(lambda: record(task["kind"], task["modules"]))), flush=True)
    else:
        check(task["kind"], task["disks"])
    os.sync()
    libc.reboot(POWER_OFF)


if __name__ == "__main__":
    main()
