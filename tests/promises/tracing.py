"""Commands as processes of their own under strace, one of whose system calls the kernel makes fail.

Unlike `operations`, which replaces Python's functions, this reaches what compiled code calls: the interpreter, pyarrow,
and the C library.
"""

import functools
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

FAULTS = {  # system call to what can come of it: an error, `short` (no byte taken), or `slow` (a delay)
    "openat": ("EIO", "EACCES", "EMFILE"),
    "read": ("EIO", "EINTR"),
    "pread64": ("EIO",),
    "write": ("EIO", "ENOSPC", "short"),
    "pwrite64": ("EIO",),
    "close": ("EIO",),
    "fsync": ("EIO", "slow"),
    "fdatasync": ("EIO", "slow"),
    "rename": ("EIO", "EACCES"),
    "link": ("EIO", "EPERM"),
    "unlink": ("EIO", "EACCES"),
    "mkdir": ("EIO", "ENOSPC"),
    "newfstatat": ("EIO", "EACCES"),
    "getdents64": ("EIO", "ENOMEM"),
    "flock": ("EIO", "ENOLCK"),
    "ftruncate": ("EIO",),
    "ioctl": ("EIO",),
    "copy_file_range": ("EIO", "ENOSPC"),
}
# Faults of these calls also last from then on.
LASTING = ("write", "pwrite64", "fsync", "fdatasync", "rename", "link", "unlink", "mkdir")
_LINE = re.compile(r"^(\d+) +(\w+)\((.*)")
_RELATIVE = re.compile(r'^(?:AT_FDCWD<[^>]*>, )?"([^"]*)"')
SLOW_US = 300_000


@functools.cache
def lacking() -> str:
    """Return why nothing can be traced here; empty where it can."""
    if shutil.which("strace") is None:
        return "strace is not installed"
    ran = subprocess.run(["strace", "-qq", "-e", "trace=none", "true"], capture_output=True, text=True, check=False)
    return "" if ran.returncode == 0 else f"strace is not permitted here: {ran.stderr.strip()[:100]}"


@dataclass(frozen=True)
class Call:
    """A system call below a folder: its number among the process's calls of this name, from 1."""

    name: str
    number: int
    description: str


@dataclass(frozen=True)
class Traced:
    """How a command under strace ended."""

    code: int
    err: str
    calls: list[Call]  # below the folder, of its main process
    struck: bool  # Whether a fault met a call below the folder.


def run(folder: Path, words: Sequence[str], log: Path, inject: str = "", names: Sequence[str] = ()) -> Traced:
    """Run a tacpipe command in ``folder``, with a fault where ``inject`` is strace's expression for one."""
    traced = ",".join(f"?{name}" for name in names or FAULTS)
    command = ["strace", "-f", "-qq", "-y", "-s", "4096", "-e", f"trace={traced}", "-e", "signal=none", "-o", str(log)]
    command += ["-e", f"inject={inject}"] if inject else []
    # an empty part is the folder
    path = os.pathsep.join(filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep)))
    ran = subprocess.run(
        [
            *command,
            sys.executable,
            "-P",
            "-m",
            "tacpipe",
            *words,
        ],  # Python looks for modules elsewhere: it would not start
        cwd=folder,
        env={**os.environ, "PYTHONHASHSEED": "0", "PYTHONPATH": path},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    calls, struck = _read(log, str(folder))
    return Traced(ran.returncode, ran.stderr, calls, struck)


def injection(call: Call, fault: str, *, lasting: bool = False) -> str:
    """Return strace's expression for a fault of one call, or of it and all that follow."""
    effect = {"short": "retval=0", "slow": f"delay_enter={SLOW_US}"}.get(fault, f"error={fault}")
    return f"{call.name}:{effect}:when={call.number}{'+' if lasting else ''}"


def _read(log: Path, folder: str) -> tuple[list[Call], bool]:
    """Return the calls of a log that meet a path below ``folder``, and whether one of them was tampered with."""
    counts: dict[tuple[str, str], int] = {}
    calls, struck, main = [], False, ""
    for line in log.read_text(errors="replace").splitlines():
        match = _LINE.match(line)
        if match is None:
            continue
        thread, name, arguments = match.groups()
        main = main or thread
        number = counts[thread, name] = counts.get((thread, name), 0) + 1
        relative = _RELATIVE.match(arguments)
        ours = folder in re.sub(r"AT_FDCWD<[^>]*>", "", arguments) or (relative and not relative[1].startswith("/"))
        if ours and thread == main:
            calls.append(Call(name, number, arguments[:200]))
            struck |= "(INJECTED)" in line or "(DELAYED)" in line
    return calls, struck
