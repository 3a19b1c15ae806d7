"""Which processes hold a device file or a local port, as far as this user may see: who keeps us out."""

from __future__ import annotations

import os
from pathlib import Path

PROCESSES = Path("/proc")


def of_file(path: str) -> list[str]:
    """Return the other processes that have ``path`` open, as ``screen (process 4711)``."""
    return _holding({str(Path(path).resolve())})


def of_port(kind: str, port: int) -> list[str]:
    """Return the processes that listen on a local port; ``kind`` is ``udp`` or ``tcp``."""
    targets = set()
    for table in (f"{kind}", f"{kind}6"):
        try:
            lines = (PROCESSES / "net" / table).read_text().splitlines()[1:]
        except OSError:
            continue
        for line in lines:
            columns = line.split()
            if int(columns[1].rpartition(":")[2], 16) == port:
                targets.add(f"socket:[{columns[9]}]")
    return _holding(targets)


def describe(holders: list[str]) -> str:
    """Return who holds it, as the end of a sentence.

    >>> describe(["screen (process 4711)"]), describe([])
    ('screen (process 4711)', 'a process of another user')
    """
    return " and ".join(holders) if holders else "a process of another user"


def _holding(targets: set[str]) -> list[str]:
    return [
        f"{_name(process)} (process {process.name})"
        for process in sorted(PROCESSES.glob("[0-9]*"), key=lambda path: int(path.name))
        if int(process.name) != os.getpid() and targets & _open_files(process)
    ]


def _open_files(process: Path) -> set[str]:
    found: set[str] = set()
    try:
        for file in (process / "fd").iterdir():
            try:
                found.add(str(file.readlink()))
            except OSError:  # closed meanwhile
                continue
    except OSError:  # another user's, or gone
        return found
    return found


def _name(process: Path) -> str:
    try:
        return (process / "comm").read_text().strip()
    except OSError:
        return "a process"
