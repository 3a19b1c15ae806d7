"""Every call of the file system below a folder, counted, and one of them made to fail as disks and people make it.

The calls of ``os``, ``fcntl`` and ``open`` are replaced while the block of a `Shim` runs, for paths below its folder
alone. What compiled code opens by itself (safetensors, a mapped file) is not seen.
"""

import builtins
import errno
import fcntl
import io
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, Self

_PATHS = {  # functions of os that take a path, and what they do
    **{
        name: name for name in ("unlink", "mkdir", "rmdir", "utime", "chmod", "truncate", "readlink", "stat", "scandir")
    },
    "remove": "unlink",
    "lstat": "stat",
    "listdir": "scandir",
}
_PAIRS = ("link", "replace", "rename", "symlink")
_HANDLES = {  # those that take an open file
    **{name: name for name in ("read", "fsync", "fdatasync", "fchmod", "sendfile", "copy_file_range")},
    "posix_fallocate": "fallocate",
    "ftruncate": "truncate",
}
TAKES_SPACE = frozenset(("create", "write", "link", "mkdir", "symlink", "fallocate", "sendfile", "copy_file_range"))
SYNCS = frozenset(("fsync", "fdatasync"))
LASTING = {"full": errno.ENOSPC, "read-only": errno.EROFS, "gone": errno.EIO}  # Faults that last from one call on.
_ERRORS = {  # Errors that a call can return.
    **dict.fromkeys(("read", "close"), ("EIO",)),
    **dict.fromkeys(("open", "stat", "scandir", "readlink", "unlink", "rmdir", "utime", "chmod"), ("EIO", "EACCES")),
    **dict.fromkeys(("create", "link", "replace", "rename", "mkdir", "symlink"), ("ENOSPC", "EIO", "EACCES")),
    **dict.fromkeys(("write", "fsync", "fdatasync", "fallocate", "sendfile", "copy_file_range"), ("ENOSPC", "EIO")),
    **dict.fromkeys(("fchmod", "truncate"), ("EIO",)),
    "flock": ("ENOLCK",),
    "ioctl": ("EOPNOTSUPP", "ENOSPC", "EIO"),
}
CHANGES = frozenset(_ERRORS) - {"open", "read", "close", "stat", "scandir", "readlink", "flock", "ioctl"}
_BY_PATH = frozenset(("open", "create", *_PATHS.values(), *_PAIRS))


@dataclass(frozen=True)
class Call:
    """One call of the file system, its paths absolute."""

    name: str
    path: str
    source: str = ""  # The source of a link or a rename.

    @property
    def changes(self) -> bool:
        """Return whether it changes the disk's content, or what outlasts a loss of power."""
        return self.name in CHANGES

    @property
    def errors(self) -> list[str]:
        """Return the faults that it can have: an error, once or from then on, or a short write."""
        faults = list(_ERRORS[self.name])
        faults += ["short", "short, then full"] if self.name == "write" else []
        faults += ["full"] if self.name in TAKES_SPACE else []
        return faults + (["read-only", "gone"] if self.changes else [])


class Watch(Protocol):
    """Is told of each call, before it and after it was made."""

    def before(self, call: Call) -> None:
        """Look at what there is before the call."""

    def after(self, call: Call) -> None:
        """Look at what there is after the call, which did not fail."""


class Shim:
    """Counts calls while its block runs, and has the call number ``at`` (from 1) fail by ``fault``."""

    def __init__(self, folder: Path, at: int = 0, fault: str = "", watch: Watch | None = None) -> None:
        self.calls: list[Call] = []
        self._folder = f"{folder}/"
        self._at, self._fault, self._watch = at, fault, watch
        self._opened: dict[int, tuple[str, bool]] = {}  # descriptor to path, and whether it is written
        self._real: dict[tuple[Any, str], Any] = {}

    def __enter__(self) -> Self:
        for name, operation in _PATHS.items():
            self._patch(os, name, self._of_path(operation, getattr(os, name)))
        for name in _PAIRS:
            self._patch(os, name, self._of_pair(name, getattr(os, name)))
        for name, operation in _HANDLES.items():
            self._patch(os, name, self._of_handle(operation, getattr(os, name)))
        for name in ("flock", "ioctl"):
            self._patch(fcntl, name, self._of_handle(name, getattr(fcntl, name)))
        for name in ("open", "write", "pwrite", "close"):
            self._patch(os, name, getattr(self, f"_{name}"))
        for module in (builtins, io):
            self._patch(module, "open", self._open_file)
        return self

    def __exit__(self, *ignored: object) -> None:
        for (module, name), real in self._real.items():
            setattr(module, name, real)

    def _patch(self, module: Any, name: str, replacement: Any) -> None:
        self._real[module, name] = getattr(module, name)
        setattr(module, name, replacement)

    # ---- which calls are ours, and what becomes of them

    def _ours(self, path: Any, folder: int | None = None) -> str | None:
        """Return the absolute path of what a call names if it lies below the folder, else None."""
        if isinstance(path, int):
            return self._opened.get(path, (None, False))[0]
        text = os.fsdecode(path)
        if folder is not None:
            parent = self._ours(folder)
            return None if parent is None else f"{parent}/{text}"
        if not text.startswith("/"):
            text = f"{os.getcwd()}/{text}"  # noqa: PTH109
        text = os.path.normpath(text)
        return text if f"{text}/".startswith(self._folder) else None

    def make(self, call: Call, real: Callable[[], Any]) -> Any:
        """Count a call and make it, unless it is to fail."""
        self._count(call)
        result = real()
        if self._watch is not None:
            self._watch.after(call)
        return result

    def write(self, path: str | None, content: Any, real: Callable[[Any], int | None]) -> int:
        """Write by ``real``, less or nothing where that is to go wrong."""
        if path is None:
            return int(real(content) or 0)
        call = Call("write", path)
        if self._count(call):
            full_content = memoryview(content).cast("B")
            content = full_content[: max(1, len(full_content) // 2)]
        count = int(real(content) or 0)
        if self._watch is not None:
            self._watch.after(call)
        return count

    def _count(self, call: Call) -> str:
        """Count a call; raise if it is to fail, return how if it is to be cut short."""
        self.calls.append(call)
        if self._watch is not None:
            self._watch.before(call)
        if len(self.calls) == self._at and self._fault.startswith("E"):
            raise _error(getattr(errno, self._fault), call)
        if len(self.calls) == self._at and self._fault.startswith("short"):
            return self._fault
        if self._at and len(self.calls) >= self._at:
            self._last(call)
        return ""

    def _last(self, call: Call) -> None:
        """Raise what a disk says from now on that is full, read-only or gone."""
        full = self._fault in ("full", "short, then full") and call.name in TAKES_SPACE
        stiff = self._fault == "read-only" and call.changes and call.name not in SYNCS
        if full or stiff or self._fault == "gone":
            raise _error(LASTING["full" if full else self._fault], call)

    # ---- replacements

    def _of_path(self, operation: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(path: Any = ".", *arguments: Any, **options: Any) -> Any:
            our_path = self._ours(path, options.get("dir_fd"))
            if our_path is None:
                return real(path, *arguments, **options)
            return self.make(Call(operation, our_path), lambda: real(path, *arguments, **options))

        return call

    def _of_pair(self, operation: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(source: Any, target: Any, **options: Any) -> Any:
            our_path = self._ours(target)
            if our_path is None:
                return real(source, target, **options)
            return self.make(
                Call(operation, our_path, self._ours(source) or ""), lambda: real(source, target, **options)
            )

        return call

    def _of_handle(self, operation: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(handle: Any, *arguments: Any, **options: Any) -> Any:
            our_path = self._ours(handle if isinstance(handle, int) else handle.fileno())
            if our_path is None:
                return real(handle, *arguments, **options)
            return self.make(Call(operation, our_path), lambda: real(handle, *arguments, **options))

        return call

    def _open(self, path: Any, flags: int, mode: int = 0o777, *, dir_fd: int | None = None) -> int:
        real = self._real[os, "open"]
        our_path = self._ours(path, dir_fd)
        if our_path is None:
            return int(real(path, flags, mode, dir_fd=dir_fd))
        name = "create" if flags & (os.O_CREAT | os.O_TRUNC) else "open"
        handle = int(self.make(Call(name, our_path), lambda: real(path, flags, mode, dir_fd=dir_fd)))
        self._opened[handle] = our_path, bool(flags & (os.O_WRONLY | os.O_RDWR))
        return handle

    def _write(self, handle: int, content: Any) -> int:
        return self.write(self._ours(handle), content, lambda part: self._real[os, "write"](handle, part))

    def _pwrite(self, handle: int, content: Any, offset: int) -> int:
        return self.write(self._ours(handle), content, lambda part: self._real[os, "pwrite"](handle, part, offset))

    def _close(self, handle: int) -> None:
        our_path, is_written = self._opened.pop(handle, (None, False))
        self._real[os, "close"](handle)  # first: a descriptor is gone, whatever the disk says to it
        if our_path is not None and is_written:
            self._count(Call("close", our_path))

    def _open_file(
        self,
        file: Any,
        mode: str = "r",
        buffering: int = -1,
        encoding: str | None = None,
        errors: str | None = None,
        newline: str | None = None,
        closefd: bool = True,
        opener: Any = None,
    ) -> Any:
        our_path = None if isinstance(file, int) or opener is not None else self._ours(file)
        if our_path is None:
            return self._real[io, "open"](file, mode, buffering, encoding, errors, newline, closefd, opener)
        raw = _File(self, our_path, "".join(letter for letter in mode if letter not in "bt"))
        self._opened[raw.fileno()] = our_path, False  # it counts its end itself
        if buffering == 0:
            return raw
        buffered: Any = io.BufferedRandom if "+" in mode else io.BufferedReader if "r" in mode else io.BufferedWriter
        stack = buffered(raw)
        return stack if "b" in mode else io.TextIOWrapper(stack, encoding, errors, newline)

    def closed(self, handle: int, call: Call, real: Callable[[], None], *, is_written: bool) -> None:
        """Close a file by ``real``."""
        self._opened.pop(handle, None)
        real()
        if is_written:
            self._count(call)


class _File(io.FileIO):
    """A file as ``open`` gives it, its reads and writes counted."""

    def __init__(self, shim: Shim, path: str, mode: str) -> None:
        self._shim, self._path = shim, path
        opening = super().__init__
        shim.make(Call("open" if mode == "r" else "create", path), lambda: opening(path, mode))

    def read(self, size: int | None = -1) -> Any:
        reading = super().read
        return self._shim.make(Call("read", self._path), lambda: reading(-1 if size is None else size))

    def readall(self) -> Any:
        return self._shim.make(Call("read", self._path), super().readall)

    def readinto(self, buffer: Any) -> Any:
        reading = super().readinto
        return self._shim.make(Call("read", self._path), lambda: reading(buffer))

    def write(self, content: Any) -> int:
        return self._shim.write(self._path, content, super().write)

    def close(self) -> None:
        if not self.closed:
            call = Call("close", self._path)
            self._shim.closed(self.fileno(), call, super().close, is_written=self.writable())


def _error(number: int, call: Call) -> OSError:
    """Return what Python raises: only calls that are given a path name it."""
    return OSError(number, os.strerror(number), *((call.path,) if call.name in _BY_PATH else ()))
