"""What the folder ``meta`` of a LeRobot dataset states: its rate, its features, and where the frames of each episode lie."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from tacpipe.errors import TacpipeError
from tacpipe.formats import unique_names
from tacpipe.formats.arrays.tree import plain_attributes
from tacpipe.io import files as file_system
from tacpipe.io import memory, parquet, regular
from tacpipe.io.parquet import BROKEN
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import excerpt, plain

INFO = "meta/info.json"
MOST_BYTES = 1 << 28  # of a file in meta
VERSIONS = ("v2.0", "v2.1", "v3.0")
DATA_PATHS = {  # where versions keep the frames, if info.json does not state it
    "v2": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
    "v3": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
}
OWN = (
    "stats/",
    "data/",
    "videos/",
    "meta/",
    "dataset_",
)  # how columns of meta/episodes begin that state where things are
NAME, ATTRIBUTES = "tacpipe/recording", "tacpipe/attributes"  # columns with what an episode was before its export
ABOUT = "meta/tacpipe.json"  # the name, unit and quantity of each value of a feature, of exported datasets
_PLACE = re.compile(r"\{(\w+)(?::0?(\d{1,2})d)?\}")  # other braces stay as they are, and name no file


@dataclass(frozen=True)
class Feature:
    """What info.json states of one column of the frames."""

    key: str
    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...] = ()  # of its values; empty: none are given, or not as many as there are values
    units: tuple[str, ...] = ()
    quantities: tuple[str, ...] = ()

    @property
    def width(self) -> int:
        """How many values a row has."""
        count = 1
        for size in self.shape:
            count *= size
        return count


@dataclass(frozen=True)
class Episode:
    """One episode: what it is called, the file with its frames, tasks, and what else is stated of it.

    ``original`` are the attributes of the recording that it was exported from, None where it was not.
    """

    name: str
    index: int
    file: str  # within the dataset
    length: int
    tasks: tuple[str, ...] = ()
    videos: Mapping[str, str] = field(default_factory=dict)  # by feature: the path within the dataset
    attributes: Mapping[str, Attribute] = field(default_factory=dict)
    original: Mapping[str, Attribute] | None = None


@dataclass(frozen=True)
class Description:
    """What a LeRobot dataset states of itself."""

    root: Path
    version: str
    fps: float
    robot: str
    features: Mapping[str, Feature]
    info: Mapping[str, Any]

    def episodes(self) -> list[Episode]:
        """Return all episodes, by index. Raises `TacpipeError`, naming the file, for what cannot be read."""
        found = self._of_parquet() if self.version == "v3.0" else self._of_lines()
        return sorted(found, key=lambda one: one.index)

    def _of_lines(self) -> Iterator[Episode]:
        path = self.root / "meta/episodes.jsonl"
        size = self.info.get("chunks_size") or 1000
        if not isinstance(size, int) or size < 1:
            raise TacpipeError(
                f"{self.root / INFO}: chunks_size is {excerpt(size)}; it must be a whole number above 0."
            )
        for entry in _lines(regular.inside(self.root, "meta/episodes.jsonl")):
            index, length = entry.get("episode_index"), entry.get("length")
            if not isinstance(index, int) or not isinstance(length, int):
                raise TacpipeError(f"{path}: {excerpt(entry)} has no whole numbers episode_index and length.")
            values = {"episode_chunk": index // size, "episode_index": index}
            others = {key: value for key, value in entry.items() if key not in ("episode_index", "length", "tasks")}
            yield Episode(
                _name(index, others),
                index,
                self._place("data_path", DATA_PATHS["v2"], values),
                length,
                tuple(map(str, entry.get("tasks") or ())),
                {key: self._place("video_path", "", {**values, "video_key": key}) for key in self._videos},
                _plain(others),
            )

    def _of_parquet(self) -> Iterator[Episode]:
        folders = file_system.walk(self.root / "meta/episodes")
        paths = sorted(Path(place, name) for place, _, names in folders for name in names if name.endswith(".parquet"))
        if not paths:
            raise TacpipeError(
                f"{self.root / 'meta/episodes'} holds no Parquet file; a dataset of version 3.0 has one."
            )
        regular.expect_inside(self.root, paths)
        for path in paths:
            names = [name for name in _schema(path) if not name.startswith("stats/")]
            for one in _table(path, names).to_pylist():
                yield self._of_row(path, one)

    def _of_row(self, path: Path, one: Mapping[str, Any]) -> Episode:
        try:
            index, length = int(one["episode_index"]), int(one["length"])
            values = {"chunk_index": int(one["data/chunk_index"]), "file_index": int(one["data/file_index"])}
        except (KeyError, TypeError, ValueError) as error:
            raise TacpipeError(
                f"{path}: a row has no whole number {plain(str(error).strip(chr(39)))}; it names episode_index, length, "
                f"data/chunk_index and data/file_index."
            ) from error
        others = {
            key: value
            for key, value in one.items()
            if key not in ("episode_index", "length", "tasks") and not key.startswith(OWN)
        }
        videos = {}
        for key in self._videos:
            at = {name: one.get(f"videos/{key}/{name}") for name in ("chunk_index", "file_index")}
            if None not in at.values():
                videos[key] = self._place("video_path", "", {**at, "video_key": key})
        file = self._place("data_path", DATA_PATHS["v3"], values)
        tasks = tuple(map(str, one.get("tasks") or ()))
        original = _original(path, one.get(ATTRIBUTES))
        return Episode(_name(index, others), index, file, length, tasks, videos, _plain(others), original)

    @property
    def _videos(self) -> list[str]:
        return [key for key, one in self.features.items() if one.dtype == "video"]

    def _place(self, key: str, usual: str, values: Mapping[str, object]) -> str:
        """Return a path within the dataset, of a pattern in info.json."""
        pattern = str(self.info.get(key) or usual)
        try:
            found = _PLACE.sub(lambda one: _filled(values[one[1]], one[2]), pattern)
        except (KeyError, ValueError) as error:
            raise TacpipeError(
                f"{self.root / INFO}: {key} is {excerpt(pattern)}, which names {plain(str(error))}; there are "
                f"{', '.join(values)}."
            ) from error
        return found


def read(root: Path) -> Description:
    """Return what a dataset states of itself. Raises `TacpipeError`, naming file and entry, for what is not as it should."""
    path = root / INFO
    info = _json(root, INFO)
    version, fps = info.get("codebase_version"), info.get("fps")
    if version not in VERSIONS:
        raise TacpipeError(
            f"{path}: codebase_version is {excerpt(version)}; {', '.join(VERSIONS)} are read. Convert it with LeRobot's own "
            f"script."
        )
    if not isinstance(fps, int | float) or not 0 < fps <= 1e6:
        raise TacpipeError(f"{path}: fps is {excerpt(fps)}; it must be a number above 0.")
    features = info.get("features")
    if not isinstance(features, dict) or not features:
        raise TacpipeError(f"{path}: features is {excerpt(features)}; it must name the columns of the frames.")
    about = _json(root, ABOUT).get("features") if (root / ABOUT).is_file() else None
    about = about if isinstance(about, dict) else {}
    made = {str(key): _feature(path, str(key), value, about.get(key)) for key, value in features.items()}
    return Description(root, version, float(fps), str(info.get("robot_type") or ""), made, info)


@contextlib.contextmanager
def parquet_errors(path: Path) -> Iterator[None]:
    """Raise what pyarrow and the system raise while a Parquet file is read as a `TacpipeError` that names it."""
    try:
        yield
    except FileNotFoundError as error:
        raise TacpipeError(f"{path} is not there, and the dataset names it. Copy the dataset again.") from error
    except BROKEN as error:
        if isinstance(error, OSError) and error.errno is not None:
            with regular.failing(path):
                raise
        raise TacpipeError(
            f"{path} is not a whole Parquet file: {plain(' '.join(str(error).split()), 200)}. Copy it again."
        ) from error


def _feature(path: Path, key: str, value: Any, about: Any) -> Feature:
    shape = value.get("shape") if isinstance(value, dict) else None
    if not isinstance(value, dict) or not isinstance(shape, list) or not all(isinstance(one, int) for one in shape):
        raise TacpipeError(f"{path}: the feature {plain(key)} is {excerpt(value)}; it must have dtype and shape.")
    made = Feature(key, str(value.get("dtype")), tuple(shape))
    about = about if isinstance(about, dict) else {}

    def each(found: Any) -> tuple[str, ...]:
        return tuple(leaves) if len(leaves := _leaves(found)) == made.width else ()

    names = each(about.get("columns")) or each(value.get("names"))
    unique = names if len(set(names)) == len(names) else ()
    return replace(made, names=unique, units=each(about.get("units")), quantities=each(about.get("quantities")))


def _leaves(names: Any) -> list[str]:
    """Return names however they are nested.

    >>> _leaves({"motors": ["a", "b"]}), _leaves([["x"], ["y"]]), _leaves(None)
    (['a', 'b'], ['x', 'y'], [])
    """
    leaves: list[str] = []
    pending = [names]
    while pending:  # however deep they are nested
        value = pending.pop()
        if isinstance(value, dict | list):
            pending += reversed(list(value.values()) if isinstance(value, dict) else value)
        elif value is not None:
            leaves.append(str(value))
    return leaves


def _name(index: int, others: Mapping[str, Any]) -> str:
    return str(others[NAME]) if others.get(NAME) else f"episode_{index:06d}"


def _plain(values: Mapping[str, Any]) -> dict[str, Attribute]:
    others = {key: value for key, value in values.items() if key not in (NAME, ATTRIBUTES)}
    return dict(plain_attributes(others))


def _original(path: Path, text: Any) -> dict[str, Attribute] | None:
    if not isinstance(text, str):
        return None
    try:
        attributes = unique_names.json_value(text, path)
    except (ValueError, RecursionError) as error:
        raise TacpipeError(f"{path}: {ATTRIBUTES} holds {excerpt(text)}, which is not JSON.") from error
    values = attributes.items() if isinstance(attributes, dict) else ()
    return {str(key): value for key, value in values if value is None or isinstance(value, str | int | float | bool)}


def _filled(value: object, width: str | None) -> str:
    return f"{int(value):0{int(width)}d}" if width else str(value)  # type: ignore[call-overload]


def _json(root: Path, name: str) -> dict[str, Any]:
    path = regular.inside(root, name)
    with regular.failing(path):
        content = regular.content(path, MOST_BYTES)
    try:
        content_json = unique_names.json_value(content, path)
    except (ValueError, RecursionError) as error:
        raise TacpipeError(f"{path} is not JSON: {plain(str(error), 200)}. Copy it again.") from error
    if not isinstance(content_json, dict):
        raise TacpipeError(f"{path} holds {excerpt(content_json)}; it must be a JSON object.")
    return content_json


def _lines(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the objects of a file of JSON lines."""
    with regular.failing(path):
        content = regular.content(path, MOST_BYTES)
    for number, line in enumerate(content.splitlines(), 1):
        if not line.strip():
            continue
        try:
            entry = unique_names.json_value(line, path)
        except (ValueError, RecursionError) as error:
            raise TacpipeError(
                f"{path}, line {number} is not JSON: {plain(str(error), 200)}. Copy the file again."
            ) from error
        if not isinstance(entry, dict):
            raise TacpipeError(f"{path}, line {number} holds {excerpt(entry)}; it must be a JSON object.")
        yield entry


def _schema(path: Path) -> Sequence[str]:
    with parquet_errors(path), regular.opened(path) as file:
        return list(pq.ParquetFile(file).schema_arrow.names)


def _table(path: Path, names: Sequence[str] | None = None) -> Any:
    parquet.require_claims(path, names, max_bytes=memory.MOST_BLOCK)
    with parquet_errors(path), regular.opened(path) as file:
        return pq.ParquetFile(file).read(columns=list(names) if names is not None else None)
