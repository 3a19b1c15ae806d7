"""The formats of containers: how their files are recognised, and their openers."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from tacpipe.errors import UsageError
from tacpipe.formats.containers.container import Container
from tacpipe.io import files as file_system
from tacpipe.io import regular


@dataclass(frozen=True)
class Kind:
    """A format of containers: files with an ending, folders with a mark, or both."""

    opener: str  # module:function, imported when a file is opened, as it may need an extra
    endings: tuple[str, ...] = ()  # endings of files, in lower case
    marks: tuple[str, ...] = ()  # a folder that holds one of these files is one container
    marked: bytes = b""  # content of the first 4 KiB of such a file


KINDS: Mapping[str, Kind] = {
    "mcap": Kind("tacpipe.formats.bags.container:open_bag", (".mcap",)),
    "rosbag": Kind(
        "tacpipe.formats.bags.container:open_bag",
        (".bag", ".bag.active", ".db3", ".mcap", ".db3.zstd", ".mcap.zstd"),
        ("metadata.yaml",),
        b"rosbag2_bagfile_information",
    ),
    "hdf5": Kind("tacpipe.formats.arrays.container:open_hdf5", (".hdf5", ".h5")),
    "zarr": Kind(
        "tacpipe.formats.arrays.container:open_zarr",
        (".zarr.zip", ".zarr"),
        (".zgroup", ".zarray", "zarr.json"),
    ),
    "xdf": Kind("tacpipe.formats.xdf_streams:XdfFile", (".xdf", ".xdfz", ".xdf.gz")),
    "lerobot": Kind("tacpipe.formats.lerobot.container:open_lerobot", (), ("meta/info.json",)),
}


def open_container(kind: str, path: Path) -> Container:
    """Return the container at ``path``."""
    module, _, function = KINDS[kind].opener.partition(":")
    return cast(Container, getattr(importlib.import_module(module), function)(path))


def is_container(kind: str, path: Path) -> bool:
    """Return whether a path looks like a container of this kind."""
    if path.is_dir():
        return any(_has_mark(path / mark, KINDS[kind].marked) for mark in KINDS[kind].marks)
    return path.name.lower().endswith(KINDS[kind].endings)


def has_ending(kind: str, name: str) -> bool:
    """Return whether a file's name ends as those of containers of this kind do."""
    return bool(KINDS[kind].endings) and name.lower().endswith(KINDS[kind].endings)


def _has_mark(path: Path, content: bytes) -> bool:
    if not content or not path.is_file():
        return path.is_file()
    with regular.failing(path), regular.opened(path) as file:
        return content in file.read(4096)


def find_containers(kind: str, source: Path) -> list[Path]:
    """Return the containers of this kind at or below ``source``, sorted; what lies within one is part of it."""
    paths = [source] if not source.is_dir() and is_container(kind, source) else []
    for place, folders, names in file_system.walk(source) if source.is_dir() else ():
        if is_container(kind, Path(place)):
            paths.append(Path(place))
            folders.clear()
            continue
        paths += [Path(place, name) for name in names if name.lower().endswith(KINDS[kind].endings)]
    return sorted(paths)


def describe_kind(kind: str) -> str:
    """Return how containers of this kind are recognised, for errors."""
    container_kind = KINDS[kind]
    files = (
        [f"files named {', '.join(f'*{ending}' for ending in container_kind.endings)}"]
        if container_kind.endings
        else []
    )
    folders = [f"folders with {' or '.join(container_kind.marks)}"] if container_kind.marks else []
    return " or ".join([*files, *folders])


def no_container_error(kind: str, source: Path) -> UsageError:
    """Return the error for a source without a container of this kind."""
    if not source.exists():
        return UsageError(f"There is no {source} to read recordings from.")
    verb = "holds no" if source.is_dir() else "is not a"
    return UsageError(f"{source} {verb} recording for ingest {kind}, which reads {describe_kind(kind)}.")


def container_files(path: Path) -> dict[str, Path]:
    """Return the files of a container: "" and its path, or of a folder each file by its path within."""
    if not path.is_dir():
        return {"": path}
    return {
        Path(place, name).relative_to(path).as_posix(): Path(place, name)
        for place, _, names in file_system.walk(path)
        for name in sorted(names)
    }


def container_names(paths: Sequence[Path], source: Path) -> dict[Path, str]:
    """Return a name for each container: that of its file without the ending, with folders above where two share one."""
    stems = {path: _name_stem(path) for path in paths}
    shared = [stem.casefold() for stem in stems.values()]
    return {
        path: stem if shared.count(stem.casefold()) == 1 else "-".join([*path.relative_to(source).parts[:-1], stem])
        for path, stem in stems.items()
    }


def _name_stem(path: Path) -> str:
    ending = max(
        (ending for kind in KINDS.values() for ending in kind.endings if path.name.lower().endswith(ending)),
        key=len,
        default="",
    )
    return path.resolve().name.removesuffix(ending) if path.is_dir() else path.name[: len(path.name) - len(ending)]


def identifiers(sources: Sequence[str]) -> dict[str, str]:
    """Return a stream's name for each source: an identifier, no two alike but for case.

    >>> identifiers(["/left/skin", "/joint_states", "left.skin", "3d"])
    {'/left/skin': 'left_skin', '/joint_states': 'joint_states', 'left.skin': 'left_skin_2', '3d': 'stream_3d'}
    """
    names: dict[str, str] = {}
    used: set[str] = set()
    for source in sources:
        letters = "".join(
            letter if letter.isascii() and (letter.isalnum() or letter == "_") else " " for letter in source
        )
        name = "_".join(letters.split()).strip("_") or "stream"
        name = f"stream_{name}" if name[0].isdigit() else name
        number = 2
        candidate = name
        while candidate.casefold() in used:
            candidate, number = f"{name}_{number}", number + 1
        used.add(candidate.casefold())
        names[source] = candidate
    return names
