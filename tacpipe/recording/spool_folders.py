"""Find the spools of a store, their owners and the abandoned ones, check their headers, and remove spools.

A store may be shared. A spool belongs to its user: others cannot open its folder, and a command seals or removes only spools
of the user who runs it. No symbolic link is followed.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import math
import os
import re
import stat
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TypedDict

from tacpipe.datasets import manifest, paths
from tacpipe.errors import TacpipeError
from tacpipe.io.files import listed
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import excerpt, plain
from tacpipe.store import layout, location
from tacpipe.store.layout import BESIDE_NAME
from tacpipe.store.store import Store

FOLDER = layout.SPOOL  # folder of the store
STARTUP_S = 60.0  # a younger spool without a header may belong to a process that is starting
NAME = re.compile(r"[0-9a-f]{32}")  # name of a spool's folder
FILES = ("header.json", ".header.json", "tally", "bytes")  # in order of removal: a spool without header is not sealed
# opening a pipe without writers would otherwise block
READ = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC


def own_user_ids(folder: Path, existing: Iterable[int]) -> frozenset[int]:
    """Return the user ids of files that this process creates in a folder. ``existing`` are the ids of its files.

    A network file system may map the process's id to another, so a temporary file is created if the ids differ.
    """
    ids = {os.geteuid()}
    if not ids.issuperset(existing):
        with contextlib.suppress(OSError), tempfile.TemporaryFile(dir=folder) as file:
            ids.add(os.fstat(file.fileno()).st_uid)
    return frozenset(ids)


def refuse_link(store: Path) -> None:
    """Raise `TacpipeError` if a store's folder of spools is a symbolic link, which may lead to another user's files."""
    if (store / FOLDER).is_symlink():
        raise TacpipeError(
            f"{store / FOLDER} is a symbolic link. Remove it. To record to another disk, set TACPIPE_STORE to a "
            f"store on it."
        )


def find_owners(store: Path) -> dict[Path, int]:
    """Return the user id of each spool by its folder. Raises `TacpipeError` if the folder of spools is a link."""
    refuse_link(store)
    owner_ids = {}
    for folder in listed(store / FOLDER):
        with contextlib.suppress(FileNotFoundError):
            status = folder.lstat()
            if stat.S_ISDIR(status.st_mode) and NAME.fullmatch(folder.name):
                owner_ids[folder] = status.st_uid
    return owner_ids


def find_abandoned(store: Path) -> list[Path]:
    """Return the folders of this user's spools that no process writes or seals, oldest first.

    Removes spools without a header whose process has ended.
    """
    folders = []
    owner_ids = find_owners(store)
    own_ids = own_user_ids(store / FOLDER, owner_ids.values())
    for folder in [folder for folder, owner in owner_ids.items() if owner in own_ids]:
        try:
            with locked(folder) as is_locked:
                age_s = time.time() - (folder / "bytes" if is_locked else folder).stat().st_mtime
                if is_locked and (folder / "header.json").exists():
                    folders.append((-age_s, folder))
                elif (
                    is_locked and age_s > STARTUP_S
                ):  # its process ended before the start of the recording or after sealing
                    remove_spool(folder)
            if not is_locked and age_s > STARTUP_S:
                folder.rmdir()  # fails for a folder that is not empty
        except (FileNotFoundError, NotADirectoryError):
            continue
        except OSError as error:
            if error.errno != errno.ENOTEMPTY:
                folders.append((0.0, folder))  # sealing it will report the error
    return [folder for _, folder in sorted(folders)]


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[bool]:
    """Lock a spool in the block. Yields False if it does not exist, or if another process writes or seals it."""
    try:
        handle = os.open(folder / "bytes", READ)
    except FileNotFoundError:
        yield False
        return
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            is_locked = os.fstat(handle).st_nlink > 0
        except BlockingIOError:
            is_locked = False
        yield is_locked
    finally:
        os.close(handle)


def remove_spool(folder: Path) -> None:
    """Remove the files of a spool, and its folder unless it contains other files."""
    with contextlib.suppress(FileNotFoundError):
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        try:
            for name in FILES:
                with contextlib.suppress(FileNotFoundError):
                    os.unlink(name, dir_fd=handle)
        finally:
            os.close(handle)
    with contextlib.suppress(OSError):
        folder.rmdir()


FILE = re.compile(r"rig-[0-9a-f]{8}\.toml")  # pattern of the names of rig files next to the recordings
MAX_CLOCK_NS = 1 << 62


def output_path(store: Store, dataset: Path) -> str:
    """Return the path of a dataset for a header: relative to the store's project, so that both can be moved.

    The path is absolute if the dataset is outside of that project, or the store is not in a project.
    """
    path, project = Path(os.path.abspath(dataset)), _project(store)  # noqa: PTH100  (links are not followed)
    return str(path.relative_to(project) if project is not None and path.is_relative_to(project) else path)


def find_destination(header: SpoolHeader, store: Store, opened: Path | None) -> Path:
    """Return the dataset to which a spool is appended.

    Raises `TacpipeError` unless it is the output of this command (``opened``), or in the project of the store or of the
    current folder. Links that lead out of the project are refused.
    """
    output = header.get("output")
    if isinstance(output, str) and output and "\0" not in output:
        for project in _projects(store):
            path = project / output
            if opened is not None and path == Path(os.path.abspath(opened)):  # noqa: PTH100
                return path
            if _is_in_project(path, project):
                return path
    raise TacpipeError(
        f"It was recorded for {excerpt(output)}, which is neither the -o of this command nor in the project of its store. "
        f"If that is right, `tacpipe acquire --recover -o` with that path seals it."
    )


class ClockReading(TypedDict):
    """The monotonic clock, and the UTC time then."""

    monotonic_ns: int
    utc_ns: int


class RecordingHeader(TypedDict, total=False):
    """The request for a recording, as the header of its spool states it."""

    output: str  # path of the dataset
    recording: str  # name
    attributes: Mapping[str, Attribute]
    duration_s: float | None  # requested duration
    keep: bool  # the spool is retained
    rig: str  # text of the rig file


class SpoolHeader(RecordingHeader):
    """The header of a spool; what another program wrote is checked by `spool_folders.check_header`."""

    streams: list[str]
    clock: ClockReading


def check_header(header: SpoolHeader, streams: Iterable[str]) -> None:
    """Raise `TacpipeError` if a header has invalid values. ``streams`` are the streams of its rig file."""
    name, attributes, clock = header.get("recording"), header.get("attributes"), header.get("clock")
    if not isinstance(name, str) or not is_name(name):
        raise TacpipeError(f"Its recording is named {excerpt(name)}, which is not a valid name of a folder.")
    if header.get("streams") != list(streams):
        raise TacpipeError(f"Its streams are {excerpt(header.get('streams'))}; they differ from those in its rig file.")
    if not isinstance(attributes, dict) or not all(_is_attribute(value) for value in attributes.values()):
        raise TacpipeError(
            f"Its attributes are {excerpt(attributes)}; each must be text, a finite number, true or false."
        )
    duration_s = header.get("duration_s")  # missing in older spools
    if not (duration_s is None or (isinstance(duration_s, int | float) and _is_attribute(duration_s))):
        raise TacpipeError(f"Its duration is {excerpt(duration_s)}; it must be a number of seconds.")
    readings = [clock.get(key) for key in ("monotonic_ns", "utc_ns")] if isinstance(clock, dict) else [None]
    if not all(type(reading) is int and abs(reading) < MAX_CLOCK_NS for reading in readings):
        raise TacpipeError(
            f"Its clock is {excerpt(clock)}; it must have monotonic_ns and utc_ns, in whole nanoseconds."
        )


def is_name(name: str) -> bool:
    """Return whether a recording can have this name: a valid folder name that no file of a dataset uses.

    >>> [is_name(name) for name in ("press-001", "木", "a/b", "../a", ".a", "manifest.json", "rig-0123abcd.toml")]
    [True, True, False, False, False, False, False]
    """
    return "/" not in name and paths.safe_path(name) and name.lower() != manifest.NAME and not FILE.fullmatch(name)


def _is_attribute(value: object) -> bool:
    return isinstance(value, str | int) or (isinstance(value, float) and math.isfinite(value))


def _project(store: Store) -> Path | None:
    """Return the project of a store, or None for a store outside of projects."""
    root = Path(os.path.abspath(store.root))  # noqa: PTH100
    return root.parent if root.name == BESIDE_NAME else None


def _projects(store: Store) -> list[Path]:
    """Return the projects that may contain a spool's dataset. Relative paths are resolved against the first."""
    project, current = _project(store), location.project()
    return [current] if project is None or project == current else [project, current]


def _is_in_project(path: Path, project: Path) -> bool:
    if not path.is_relative_to(project) or not paths.safe_path(path.relative_to(project).as_posix()):
        return False
    return path.resolve().is_relative_to(project.resolve())


COMPLETED, INTERRUPTED, RECOVERED = "completed", "interrupted", "recovered"  # values of the attribute `ended`
REASONS = {
    INTERRUPTED: "interrupted before its end",
    RECOVERED: "recovered after a crash or a power failure",
}
MAX_LINES = 20
UNCERTAIN = "_uncertain_samples"  # suffix of attributes


class StreamDuration(TypedDict, total=False):
    """The duration of a stream among its other figures."""

    duration_s: float


def describe_incomplete(
    attributes: Iterable[tuple[str, Mapping[str, Attribute]]], recordings: Mapping[str, Mapping[str, StreamDuration]]
) -> list[str]:
    """Return one line per incomplete recording, and one per recording with uncertain arrival times.

    ``attributes`` has the name and the attributes of each recording, ``recordings`` the figures of its streams by name.
    """
    lines = []
    for name, values in attributes:
        if (ended := values.get("ended")) in REASONS:
            figures = recordings.get(name, {}).values()
            durations_s = [stream["duration_s"] for stream in figures if "duration_s" in stream]
            requested_s = values.get("requested_duration_s")
            part = f" of {requested_s:g}" if isinstance(requested_s, int | float) else ""
            duration = f", {max(durations_s):.1f}{part} s" if durations_s else ""
            lines.append(f"not completed: {plain(name)}: {REASONS[str(ended)]}{duration}")
        late = {stream: count for stream, count in values.items() if stream.endswith(UNCERTAIN)}
        if late:
            described = ", ".join(
                f"{count} samples of {plain(key.removesuffix(UNCERTAIN))}" for key, count in late.items()
            )
            lines.append(f"recorder delayed: {plain(name)}: the arrival time of {described} is uncertain")
    return lines[:MAX_LINES] + ([f"… and {len(lines) - MAX_LINES} more"] if len(lines) > MAX_LINES else [])
