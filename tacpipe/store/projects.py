"""The identity of a project, under which it pushes to other stores: created once and stored in the project's store.

If a folder is created again each time, as in a continuous integration job, the environment provides the identity
instead.
"""

from __future__ import annotations

import json
import os
import platform
import uuid
from dataclasses import asdict, dataclass
from pathlib import Path

from tacpipe.errors import DamagedError, StorageError, UsageError
from tacpipe.io import regular
from tacpipe.io.files import may_not_write, readable_errors
from tacpipe.io.hashing import digest
from tacpipe.printable import plain
from tacpipe.store.location import project, project_folder
from tacpipe.store.store import Store

FOLDER = "projects"  # folder in the store
VARIABLE = "TACPIPE_PROJECT"
_FILE_BYTES = 1 << 16  # maximum size of an identity file
_NAME_LETTERS = 60


@dataclass(frozen=True)
class Project:
    """The unique identity of a project and its readable name, which is that of its folder."""

    id: str  # hex digits
    name: str


def place(directory: Path) -> tuple[Path, str]:
    """Return the folder of a dataset's project, and the dataset's name, which is its path in that folder.

    Without a project mark, the folder is the working directory, or the dataset's parent if it is outside of it. A
    dataset in the project's folder itself has the folder's name.
    """
    path = Path(os.path.abspath(directory))  # noqa: PTH100  (a name holds no ".." and follows no link)
    folder = project(path)
    if project_folder(path) is None and folder not in path.parents:
        folder = path.parent
    name = str(path.relative_to(folder)) if folder in path.parents else path.name
    return folder, name or "dataset"


def from_environment() -> Project | None:
    """Return the project named by the environment, equal on every computer, or None if it names none.

    Raises `UsageError` for an invalid name.

    >>> os.environ["TACPIPE_PROJECT"] = "slip detection"
    >>> from_environment().name, from_environment() == from_environment()
    ('slip detection', True)
    >>> del os.environ["TACPIPE_PROJECT"]
    """
    name = os.environ.get(VARIABLE, "")
    if not name:
        return None
    if _printable(name) != name or name != name.strip():
        raise UsageError(
            f"{VARIABLE} is {plain(name, 80)!r}; the name of a project has {_NAME_LETTERS} printable letters at most, no "
            f"colon, and no space at its ends."
        )
    return Project(digest(["named project", name])[:32], name)


def identity_of(store: Store, folder: Path) -> Project | None:
    """Return the identity of the project in ``folder``, or None if it has none.

    It has one after its first push, or if `from_environment` returns one. Raises `DamagedError` if it is damaged,
    because a new identity would make it another project.
    """
    if (project := from_environment()) is not None:
        return project
    file = _file(store, folder)
    try:
        with readable_errors(store.root, reading=True):
            value = regular.json_value(file, _FILE_BYTES)
    except FileNotFoundError:
        return None
    except (ValueError, RecursionError, regular.IrregularError):
        value = None
    sound = isinstance(value, dict) and value.pop("check", None) == digest(value)
    if not (sound and all(isinstance(value.get(key), str) for key in ("id", "name"))):
        raise DamagedError(
            f"{file}, the identity of the project {folder}, is damaged. Restore it, or remove it and name with "
            f"`tacpipe store push --project NAME` the project that this one is in the other store."
        )
    return Project(value["id"], value["name"])


def identify(store: Store, folder: Path, *, writable: bool = True) -> Project:
    """Return the identity of the project in ``folder``, creating it if necessary.

    If the store is not ``writable``, the identity is derived from the computer and the paths.
    """
    existing = identity_of(store, folder)
    if existing is not None:
        return existing
    try:
        store.prepare()
        _write_identity(store, folder, Project(new_id(), _name(folder)), exclusive=True)
    except StorageError as error:
        if writable or not may_not_write(error):
            raise
        derived = digest([platform.node(), str(store.root.absolute()), str(folder)])[:32]
        return Project(derived, _name(folder))
    written = identity_of(store, folder)  # the identity that the first process wrote is valid
    assert written is not None
    return written


def new_id() -> str:
    """Return a new unique id."""
    return uuid.uuid4().hex


def join(store: Store, folder: Path, project: Project) -> None:
    """Make ``project`` the identity of the project in ``folder``, as on a second computer.

    Raises `UsageError` if the environment names another one.
    """
    configured = from_environment()
    if configured is not None and configured != project:
        raise UsageError(
            f"{VARIABLE} names the project {configured.name}, so --project {project.name} has no effect. Unset one."
        )
    store.prepare()
    _write_identity(store, folder, project, exclusive=False)


def _write_identity(store: Store, folder: Path, project: Project, *, exclusive: bool) -> None:
    """Write the identity of the project in ``folder``; if it is ``exclusive``, an existing one stays."""
    kind, name = store.roots.kind_and_name(folder)
    value = {"kind": kind, "folder": name, **asdict(project)}
    file = _file(store, folder)
    text = json.dumps({**value, "check": digest(value)}, sort_keys=True)
    store.write_file(file, text.encode(), exclusive=exclusive)
    store.sync(file)


def _file(store: Store, folder: Path) -> Path:
    return store.root / FOLDER / f"{digest(['project', *store.roots.kind_and_name(folder)])}.json"


def _name(folder: Path) -> str:
    """Return a folder's name with only characters that can be typed and displayed in a terminal.

    >>> _name(Path("/lab/slip detection")), _name(Path("/lab/a:b")), _name(Path("/"))
    ('slip detection', 'a-b', 'project')
    """
    return _printable(folder.name) or "project"


def _printable(name: str) -> str:
    return "".join("-" if letter == ":" or not letter.isprintable() else letter for letter in name)[:_NAME_LETTERS]
