"""Read the folder ``meta`` of a LeRobot dataset: its rate, features, and the file of each episode."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypedDict

import pyarrow.parquet as pq

from tacpipe.errors import TacpipeError
from tacpipe.formats import container
from tacpipe.formats.arrays.tree import plain_attributes
from tacpipe.formats.faults import explaining
from tacpipe.io import files as file_system
from tacpipe.io import memory, parquet, regular
from tacpipe.io.parquet import BROKEN
from tacpipe.plugins.stage import Attribute, Values
from tacpipe.printable import excerpt, plain

INFO = "meta/info.json"
MAX_META_BYTES = 1 << 28  # maximum size of a file in meta
VERSIONS = ("v2.0", "v2.1", "v3.0")
DATA_PATHS = {  # default path patterns of the frames by version
    "v2": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
    "v3": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
}
# prefixes of columns of meta/episodes that locate files
LOCATION_PREFIXES = ("stats/", "data/", "videos/", "meta/", "dataset_")
NAME, ATTRIBUTES = "tacpipe/recording", "tacpipe/attributes"  # columns with an episode's original name and attributes
ABOUT = "meta/tacpipe.json"  # name, unit and quantity of each value of a feature, in exported datasets
MAX_VALUES = (1 << 31) - 1  # maximum number of values of a list in Arrow
_PLACE = re.compile(r"\{(\w+)(?::0?(\d{1,2})d)?\}")  # other braces are literal


@dataclass(frozen=True)
class FeatureDescription:
    """The description of one column of the frames in info.json."""

    key: str
    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...] = ()  # names of its values; empty if their number does not match
    units: tuple[str, ...] = ()
    quantities: tuple[str, ...] = ()

    @property
    def width(self) -> int:
        """Number of values per row."""
        count = 1
        for size in self.shape:
            count *= size
        return count


@dataclass(frozen=True)
class EpisodeDescription:
    """One episode: its name, frame file, tasks and further metadata.

    ``original`` are the attributes of the recording that it was exported from, or None if it was not exported by
    tacpipe.
    """

    name: str
    index: int
    file: str  # path of the frames in the dataset
    length: int
    tasks: tuple[str, ...] = ()
    videos: Mapping[str, str] = field(default_factory=dict)  # path of the video in the dataset, by feature
    attributes: Mapping[str, Attribute] = field(default_factory=dict)
    original: Mapping[str, Attribute] | None = None
    # start time in the video by feature, 0 if missing
    video_starts_s: Mapping[str, float] = field(default_factory=dict)


class InfoFile(TypedDict, total=False):
    """The entries of ``info.json``, which may be damaged, that are read."""

    codebase_version: str
    fps: float
    robot_type: str
    chunks_size: int
    data_path: str  # pattern of the paths of frames
    video_path: str
    features: dict[str, Any]  # dtype, shape and names


@dataclass(frozen=True)
class LeRobotDescription:
    """The description of a LeRobot dataset in its folder meta."""

    root: Path
    version: str
    fps: float
    robot: str
    features: Mapping[str, FeatureDescription]
    info: InfoFile

    def episodes(self) -> list[EpisodeDescription]:
        """Return all episodes by index. Raises `TacpipeError` with the file's name if one cannot be read."""
        episodes = self._episodes_from_parquet() if self.version == "v3.0" else self._episodes_from_lines()
        return sorted(episodes, key=lambda episode: episode.index)

    def _episodes_from_lines(self) -> Iterator[EpisodeDescription]:
        """Yield the episodes of a dataset of version 2, from ``meta/episodes.jsonl``.

        Raises `TacpipeError` if it is invalid.
        """
        path = self.root / "meta/episodes.jsonl"
        size = self.info.get("chunks_size") or 1000
        if not isinstance(size, int) or size < 1:
            raise TacpipeError(
                f"{self.root / INFO}: chunks_size is {excerpt(size)}; it must be a whole number above 0."
            )
        for entry in _read_json_lines(regular.inside(self.root, "meta/episodes.jsonl")):
            index, length = entry.get("episode_index"), entry.get("length")
            if not isinstance(index, int) or not isinstance(length, int):
                raise TacpipeError(f"{path}: {excerpt(entry)} has no whole numbers episode_index and length.")
            numbers = {"episode_chunk": index // size, "episode_index": index}
            videos = {key: self._format_path("video_path", "", {**numbers, "video_key": key}) for key in self._videos}
            file = self._format_path("data_path", DATA_PATHS["v2"], numbers)
            yield _describe_episode(index, length, file, entry, videos)

    def _episodes_from_parquet(self) -> Iterator[EpisodeDescription]:
        """Yield the episodes of a dataset of version 3, from ``meta/episodes``.

        Raises `TacpipeError` if there are none.
        """
        folders = file_system.walk(self.root / "meta/episodes")
        paths = sorted(
            Path(folder, name) for folder, _, names in folders for name in names if name.endswith(".parquet")
        )
        if not paths:
            raise TacpipeError(
                f"{self.root / 'meta/episodes'} holds no Parquet file; a dataset of version 3.0 has one."
            )
        regular.expect_inside(self.root, paths)
        for path in paths:
            names = [name for name in _column_names(path) if not name.startswith("stats/")]
            for row in _read_table(path, names).to_pylist():
                yield self._episode_from_row(path, row)

    def _episode_from_row(self, path: Path, row: Values) -> EpisodeDescription:
        """Return the episode that a row of ``path`` describes. Raises `TacpipeError` if the row has no valid numbers."""
        try:
            index, length = int(row["episode_index"]), int(row["length"])
            values = {"chunk_index": int(row["data/chunk_index"]), "file_index": int(row["data/file_index"])}
        except (KeyError, TypeError, ValueError) as error:
            raise TacpipeError(
                f"{path}: a row has no whole number {plain(str(error).strip(chr(39)))}; it names episode_index, length, "
                f"data/chunk_index and data/file_index."
            ) from error
        videos = {}
        starts_s = {}
        for key in self._videos:
            file_numbers = {name: row.get(f"videos/{key}/{name}") for name in ("chunk_index", "file_index")}
            if None not in file_numbers.values():
                videos[key] = self._format_path("video_path", "", {**file_numbers, "video_key": key})
                start_s = row.get(f"videos/{key}/from_timestamp")
                starts_s[key] = float(start_s) if isinstance(start_s, int | float) else 0.0
        file = self._format_path("data_path", DATA_PATHS["v3"], values)
        stated = {key: value for key, value in row.items() if not key.startswith(LOCATION_PREFIXES)}
        episode = _describe_episode(index, length, file, stated, videos)
        return replace(episode, original=_original_attributes(path, row.get(ATTRIBUTES)), video_starts_s=starts_s)

    @property
    def _videos(self) -> list[str]:
        return [key for key, feature in self.features.items() if feature.dtype == "video"]

    def _format_path(self, key: str, default: str, values: Mapping[str, str | int | None]) -> str:
        """Return a path in the dataset from a pattern in info.json, or from ``default``.

        Raises `TacpipeError` if the pattern contains an unknown name.
        """
        pattern = str(self.info.get(key) or default)
        try:
            path = _PLACE.sub(lambda match: _format_number(values[match[1]], match[2]), pattern)
        except (KeyError, ValueError) as error:
            raise TacpipeError(
                f"{self.root / INFO}: {key} is {excerpt(pattern)}, which names {plain(str(error))}; there are "
                f"{', '.join(values)}."
            ) from error
        return path


def read_description(root: Path) -> LeRobotDescription:
    """Return the description of a dataset. Raises `TacpipeError` with file and entry if it is invalid."""
    path = root / INFO
    info: InfoFile = _read_json(root, INFO)
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
    declared_by_tacpipe = _read_json(root, ABOUT).get("features") if (root / ABOUT).is_file() else None
    declared_by_tacpipe = declared_by_tacpipe if isinstance(declared_by_tacpipe, dict) else {}
    parsed_features = {
        str(key): _parse_feature(path, str(key), value, declared_by_tacpipe.get(key)) for key, value in features.items()
    }
    return LeRobotDescription(root, version, float(fps), str(info.get("robot_type") or ""), parsed_features, info)


@contextlib.contextmanager
def parquet_errors(path: Path) -> Iterator[None]:
    """Raise errors of pyarrow and the system in the block as a `TacpipeError` with the file's name."""
    with explaining(BROKEN, f"{path} is not a whole Parquet file: ", ". Copy it again.", path=path):
        try:
            yield
        except FileNotFoundError as error:
            raise TacpipeError(f"{path} is not there, and the dataset names it. Copy the dataset again.") from error


def _parse_feature(path: Path, key: str, value: Any, about: Any) -> FeatureDescription:
    """Return the feature ``key`` with ``value``, its entry in info.json, and ``about``, its entry in an exported dataset.

    Raises `TacpipeError` if the entry has no dtype or shape.
    """
    shape = value.get("shape") if isinstance(value, dict) else None
    if not isinstance(value, dict) or not isinstance(shape, list) or not all(isinstance(size, int) for size in shape):
        raise TacpipeError(f"{path}: the feature {plain(key)} is {excerpt(value)}; it must have dtype and shape.")
    feature = FeatureDescription(key, str(value.get("dtype")), tuple(shape))
    if min(shape, default=0) < 0 or feature.width > MAX_VALUES:
        raise TacpipeError(
            f"{path}: the feature {plain(key)} has the shape {excerpt(shape)}; a frame has at most {MAX_VALUES:,} values."
        )
    exported = about if isinstance(about, dict) else {}

    def texts_per_value(texts: Any) -> tuple[str, ...]:
        names = [str(name) for name in leaves(texts) if name is not None]
        return tuple(names) if len(names) == feature.width else ()

    names = texts_per_value(exported.get("columns")) or texts_per_value(value.get("names"))
    unique = names if len(set(names)) == len(names) else ()
    return replace(
        feature,
        names=unique,
        units=texts_per_value(exported.get("units")),
        quantities=texts_per_value(exported.get("quantities")),
    )


def leaves(nested: Any) -> list[Any]:
    """Return the values in arbitrarily nested lists and mappings.

    >>> leaves({"motors": ["a", "b"]}), leaves([["x"], ["y"]]), leaves(None)
    (['a', 'b'], ['x', 'y'], [None])
    """
    values: list[Any] = []
    pending = [nested]
    while pending:  # a loop, because deep nesting would exceed the recursion limit
        value = pending.pop()
        if isinstance(value, dict | list):
            pending += reversed(list(value.values()) if isinstance(value, dict) else value)
        else:
            values.append(value)
    return values


def _describe_episode(
    index: int, length: int, file: str, values: Values, videos: Mapping[str, str]
) -> EpisodeDescription:
    """Return the description of an episode; further ``values`` of its entry in meta are its attributes."""
    name = str(values[NAME]) if values.get(NAME) else f"episode_{index:06d}"
    own_keys = ("episode_index", "length", "tasks", NAME, ATTRIBUTES)
    attributes = plain_attributes({key: value for key, value in values.items() if key not in own_keys})
    tasks = tuple(map(str, values.get("tasks") or ()))
    return EpisodeDescription(name, index, file, length, tasks, videos, attributes)


def _original_attributes(path: Path, text: Any) -> dict[str, Attribute] | None:
    """Return the attributes in a JSON text of an exported dataset, or None without a text.

    Raises `TacpipeError` if it is not JSON.
    """
    if not isinstance(text, str):
        return None
    try:
        attributes = container.json_value(text, path)
    except (ValueError, RecursionError) as error:
        raise TacpipeError(f"{path}: {ATTRIBUTES} holds {excerpt(text)}, which is not JSON.") from error
    return container.plain_values(attributes if isinstance(attributes, dict) else {})


def _format_number(value: object, width: str | None) -> str:
    return f"{int(value):0{int(width)}d}" if width else str(value)  # type: ignore[call-overload]


def _read_json(root: Path, name: str) -> Any:
    """Return the JSON object in a file of the dataset. Raises `TacpipeError` if it is none."""
    path = regular.inside(root, name)
    with regular.failing(path):
        content = regular.content(path, MAX_META_BYTES)
    with explaining((ValueError, RecursionError), f"{path} is not JSON: ", ". Copy it again."):
        content_json = container.json_value(content, path)
    if not isinstance(content_json, dict):
        raise TacpipeError(f"{path} holds {excerpt(content_json)}; it must be a JSON object.")
    return content_json


def _read_json_lines(path: Path) -> Iterator[Values]:
    """Yield the objects in a JSON Lines file. Raises `TacpipeError` with the line of anything else."""
    with regular.failing(path):
        content = regular.content(path, MAX_META_BYTES)
    for number, line in enumerate(content.splitlines(), 1):
        if not line.strip():
            continue
        with explaining((ValueError, RecursionError), f"{path}, line {number} is not JSON: ", ". Copy the file again."):
            entry = container.json_value(line, path)
        if not isinstance(entry, dict):
            raise TacpipeError(f"{path}, line {number} holds {excerpt(entry)}; it must be a JSON object.")
        yield entry


def _column_names(path: Path) -> Sequence[str]:
    with parquet_errors(path), regular.opened(path) as file:
        return list(pq.ParquetFile(file).schema_arrow.names)


def _read_table(path: Path, names: Sequence[str] | None = None) -> Any:
    parquet.require_claims(path, names, max_bytes=memory.MAX_BLOCK_BYTES)
    with parquet_errors(path), regular.opened(path) as file:
        return pq.ParquetFile(file).read(columns=list(names) if names is not None else None)
