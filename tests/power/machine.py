"""User-mode Linux: a kernel that is a program, whose root is this computer's, read-only, and whose disks are files."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
MODULES = Path("/usr/lib/uml/modules")
MEMORY = "768M"
LIMIT_S = 1200
MAKE = {"ext4": ["mkfs.ext4", "-q", "-F"], "xfs": ["mkfs.xfs", "-q"], "btrfs": ["mkfs.btrfs", "-q"]}
SIZE_MB = {"ext4": 64, "xfs": 320, "btrfs": 128}  # hardly more than each needs
PATH = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"
TOOLS = {  # Programs that are needed, with the Debian packages that have them.
    "linux.uml": "user-mode-linux",
    "dmsetup": "dmsetup",
    "mkfs.ext4": "e2fsprogs",
    "mkfs.xfs": "xfsprogs",
    "mkfs.btrfs": "btrfs-progs",
}


def lacking(tools: Mapping[str, str] = TOOLS) -> str:
    """Return which Debian packages are missing for these tools, nothing if all are there."""
    return " ".join(sorted({package for tool, package in tools.items() if shutil.which(tool, path=PATH) is None}))


def modules() -> Path:
    """Return where the kernel's modules for logged disks are."""
    (folder,) = MODULES.glob("*/kernel/drivers/md")
    return folder


def blank(path: Path, size_mb: int) -> Path:
    """Return a sparse file of this size."""
    with path.open("wb") as file:
        file.truncate(size_mb << 20)
    return path


def format_disk(path: Path, kind: str, size_mb: int | None = None) -> Path:
    """Return a disk with an empty file system, of the least size without ``size_mb``."""
    blank(path, size_mb or SIZE_MB[kind])
    subprocess.run([*MAKE[kind], str(path)], check=True, capture_output=True, env={**os.environ, "PATH": PATH})
    return path


def run(
    disks: Sequence[Path], task: Mapping[str, Any], scratch: Path, environment: Mapping[str, str]
) -> list[dict[str, Any]]:
    """Boot with these disks, do the ``task`` of `guest`, and return its answers."""
    task_file = scratch / "task.json"
    task_file.write_text(json.dumps(task))
    command = f"cd {ROOT}\nexec {sys.executable} -B -m tests.power.guest {task_file}\n"
    ran = boot(disks, command, scratch, environment)
    answers = [line.partition("RESULT ")[2] for line in ran.stdout.splitlines() if "RESULT {" in line]
    assert answers, ran.stdout[-3000:] + ran.stderr[-1000:]
    return [json.loads(answer) for answer in answers]


def boot(
    disks: Sequence[Path], command: str, scratch: Path, environment: Mapping[str, str]
) -> subprocess.CompletedProcess[str]:
    """Boot with these disks, run lines of a shell as the first process, and return what was printed."""
    first = scratch / "init"
    exports = "".join(f"export {name}='{value}'\n" for name, value in environment.items())
    first.write_text(f"#!/bin/sh\n{exports}{command}")
    first.chmod(0o755)
    root = ("root=/dev/root", "rootfstype=hostfs", "rootflags=/", "ro", f"init={first}")
    return subprocess.run(
        [
            *("linux.uml", f"mem={MEMORY}", *root, "con=null", "con0=fd:0,fd:1", "quiet"),
            *(f"ubd{chr(ord('a') + number)}={disk}" for number, disk in enumerate(disks)),
        ],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=LIMIT_S,
        check=False,
        env={**os.environ, "TMPDIR": "/dev/shm", "PATH": PATH},
    )
