"""Measure the memory available to this process, to reject files that declare more before it is allocated."""

from __future__ import annotations

import contextlib
import errno
import os
import resource
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tacpipe.errors import ShortageError, TacpipeError

MEMINFO = Path("/proc/meminfo")
STATM = Path("/proc/self/statm")
GROUPS = Path("/sys/fs/cgroup")  # memory limits and use of containers
OWN_GROUPS = Path("/proc/self/cgroup")  # control groups of this process
_VERSIONS = {  # files of limit and use by version, and the entry of reclaimable bytes in memory.stat
    "": ("memory.max", "memory.current", "inactive_file"),
    "memory": ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
}
AT_HAND = 1 << 26  # size of a request below which it is not checked
MAX_BLOCK_BYTES = 1 << 28  # maximum unpacked size of a chunk, a page or a record of a file
KEPT = 0.9  # fraction of the available memory that a file may declare
SCARCE = 1 << 29  # a request that fails with more memory available than this was larger than a valid file needs
LIBRARIES = {  # address space needed to load each library with its threads, measured on 2 cores
    "numpy": 140 << 20,
    "pyarrow": 384 << 20,
    "sklearn": 512 << 20,
    "torch": 768 << 20,
    "open3d": 1200 << 20,
}
A_CORE = 32 << 20  # bytes for each further core's thread of numpy's linear algebra
_NO_ROOM = ("failed to map segment", "cannot allocate memory", "can't allocate memory", "not enough memory")
_NO_THREAD = ("can't start new thread", "Resource temporarily unavailable")


def available() -> int:
    """Return the number of bytes that this process can still allocate, limited by the computer, its container and ulimit."""
    free_bytes = [1 << 62]
    with contextlib.suppress(OSError, ValueError, IndexError):
        fields = dict(line.split(":", 1) for line in MEMINFO.read_text().splitlines())
        free_bytes.append(int(fields["MemAvailable"].split()[0]) << 10)
    free_bytes += _left_in_groups()
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY:
        with contextlib.suppress(OSError, ValueError, IndexError):
            free_bytes.append(limit - int(STATM.read_text().split()[0]) * resource.getpagesize())
    return max(0, min(free_bytes))


def _left_in_groups() -> Iterator[int]:
    """Yield the available bytes of each control group (version 1 or 2) of this process and its parents."""
    lines = ["0::/", "0:memory:/"]  # the paths visible in a container
    with contextlib.suppress(OSError):
        lines += OWN_GROUPS.read_text().splitlines()
    groups: dict[Path, str] = {}
    for line in lines:
        _, controllers, path = line.split(":", 2)
        version = "memory" if "memory" in controllers.split(",") else controllers
        if version in _VERSIONS:
            group = GROUPS / version / path.strip("/")
            groups |= dict.fromkeys(
                [group, *group.parents[: len(group.parts) - len((GROUPS / version).parts)]], version
            )
    for group, version in groups.items():
        limit_file, used, reclaimable = _VERSIONS[version]
        with contextlib.suppress(OSError, ValueError):  # "max" if there is no limit
            group_bytes = int((group / limit_file).read_text()) - int((group / used).read_text())
            with contextlib.suppress(OSError, ValueError):
                counts = dict(line.split(maxsplit=1) for line in (group / "memory.stat").read_text().splitlines())
                group_bytes += int(counts.get(reclaimable, 0))
            yield group_bytes


def limited() -> bool:
    """Return whether this process has an address space limit, as set by ``ulimit -v``."""
    return resource.getrlimit(resource.RLIMIT_AS)[0] != resource.RLIM_INFINITY


def scarce() -> bool:
    """Return whether so little memory is available that a failed request implies nothing about the file."""
    return available() < SCARCE


def shortage(error: BaseException) -> ShortageError | None:
    """Return an error about exhausted memory or threads if ``error`` or its causes indicate that, else None."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, ShortageError):
            return cause
        if _is_shortage(cause):
            return _shortage_error(f"memory ran out ({' '.join(str(cause).split())[:160] or type(cause).__name__})")
        cause = cause.__cause__ or cause.__context__
    return None


def _is_shortage(error: BaseException) -> bool:
    """Return whether an error is, or may be, caused by exhausted memory or threads."""
    if isinstance(error, MemoryError) or (isinstance(error, SystemError) and scarce()):
        return True
    if isinstance(error, OSError) and error.errno in (errno.ENOMEM, errno.EAGAIN):
        return True
    if isinstance(error, OSError) and error.errno is None and scarce():  # Arrow and other libraries report no cause
        return True
    text = str(error)
    if isinstance(error, ImportError) and any(words in text for words in _NO_ROOM):
        return True
    return isinstance(error, RuntimeError) and any(words in text for words in (*_NO_ROOM, *_NO_THREAD))


def _shortage_error(need: str) -> ShortageError:
    """Return the error for a command that lacks the memory or threads described by ``need``."""
    limit = (
        f", of the {_megabytes(resource.getrlimit(resource.RLIMIT_AS)[0])} that `ulimit -v` allows" if limited() else ""
    )
    return ShortageError(
        f"This command needs more memory than there is: {need}; {_megabytes(available())} are left{limit}. Finished "
        f"results are kept: run the same command again with more, or with a smaller --jobs."
    )


def _megabytes(count: int) -> str:
    return f"{count / 1e6:,.0f} MB"


def guard() -> None:
    """Under an address space limit, load libraries only if there is room for them, and reserve no memory in advance.

    Otherwise their threads abort the process. Called once, before any of them is loaded.
    """
    if limited():
        os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")  # other memory pools reserve a gigabyte at once
        sys.meta_path.insert(0, _Guard())


class _Guard:
    """Finds no modules, but raises `ShortageError` for a library that there is no room for."""

    def find_spec(self, name: str, path: Any, target: Any = None) -> None:
        if name in LIBRARIES:
            require_library(name)


def require_library(name: str) -> None:
    """Raise `ShortageError` if loading a library of `LIBRARIES` needs more address space than is available under a limit."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    needed = LIBRARIES[name] + A_CORE * max(0, cores - 2)
    if limited() and available() < needed:
        raise _shortage_error(f"{name} takes {_megabytes(needed)} to load")


@contextlib.contextmanager
def raising_shortage() -> Iterator[None]:
    """Convert errors about exhausted memory to `ShortageError`."""
    try:
        yield
    except Exception as error:
        if not isinstance(error, TacpipeError) and (short := shortage(error)) is not None:
            raise short from error
        raise


def require(needed: int, source: str, *, error: type[TacpipeError] = TacpipeError) -> None:
    """Raise ``error``, a `TacpipeError`, if ``source`` needs more memory than is available."""
    if needed <= AT_HAND:
        return
    limit = int(available() * KEPT)
    if needed > limit:
        raise error(
            f"{source} declares {readable_size(needed)} of data, and {readable_size(limit)} of memory are left. If that "
            "is what you expect, read it on a computer with more memory or in parts; if its source is untrusted, do "
            "not use it."
        )


def require_block(size: int, source: str) -> None:
    """Raise `TacpipeError` if a chunk, a page or a record of a file declares more than `MAX_BLOCK_BYTES` bytes."""
    if size > MAX_BLOCK_BYTES:
        raise TacpipeError(
            f"{source} declares {readable_size(size)} in one piece; at most {readable_size(MAX_BLOCK_BYTES)} are read at "
            "once. Write it in smaller chunks; if its source is untrusted, do not use it."
        )


_bounds: list[int] = []  # limits of the blocks that run now, in any thread
_bounds_lock = threading.Lock()
_unbounded = resource.RLIM_INFINITY  # limit of the process without them


def _set_bounds(*, added: int | None = None, removed: int | None = None) -> None:
    """Add or remove the limit of a block, and set the limit of the process to the smallest one."""
    global _unbounded
    with _bounds_lock:
        soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
        if not _bounds:
            _unbounded = soft
        if added is not None:
            _bounds.append(added)
        if removed is not None:
            _bounds.remove(removed)
        limits = [limit for limit in (*_bounds, _unbounded, hard) if limit != resource.RLIM_INFINITY]
        resource.setrlimit(resource.RLIMIT_DATA, (min(limits) if _bounds else _unbounded, hard))


@contextlib.contextmanager
def bounded(max_bytes: int, source: str) -> Iterator[None]:
    """Raise `TacpipeError` if the block allocates more than ``max_bytes``, on Linux.

    This is for libraries that unpack files without checking the unpacked size. Blocks of several threads may overlap.
    """
    try:
        limit = int(STATM.read_text().split()[5]) * resource.getpagesize() + max_bytes
    except (OSError, ValueError, IndexError):
        yield
        return
    _set_bounds(added=limit)
    failure: Exception | None = None
    try:
        yield
    except Exception as error:
        failure = error
    finally:
        _set_bounds(removed=limit)
    if isinstance(failure, MemoryError) or (failure is not None and "alloc" in str(failure).lower()):
        raise TacpipeError(
            f"{source} unpacks to more than {readable_size(max_bytes)}, which is more than it declares or than is read at "
            "once. If its source is untrusted, do not use it."
        ) from failure
    if failure is not None:
        raise failure


def readable_size(count: int) -> str:
    """Return a number of bytes in a readable unit.

    >>> readable_size(2_500_000_000), readable_size(10)
    ('2.5 GB', '0.00001 MB')
    """
    if count >= 1e8:
        return f"{count / 1e9:,.1f} GB"
    return f"{count / 1e6:g} MB" if count >= 1000 else f"{count / 1e6:.5f} MB"
