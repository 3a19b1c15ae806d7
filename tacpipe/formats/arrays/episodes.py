"""Find the recordings in a tree of arrays, the arrays of each stream, and their timestamps or rate."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np

from tacpipe.arrays import AnyArray
from tacpipe.channels import schema
from tacpipe.errors import TacpipeError
from tacpipe.formats.arrays.tree import (
    ArrayDescription,
    StoredAttributes,
    Tree,
    is_frames,
    pixel_format,
    reason_left_out,
    walk,
)
from tacpipe.formats.container import Time, TimeUnit, json_object, natural_order
from tacpipe.formats.table import stamps
from tacpipe.io import memory
from tacpipe.printable import plain

NUMBERED = re.compile(
    r"(demo|episode|ep|traj|trajectory|trial|run|recording|rollout|seq|sequence)s?[_-]?\d+", re.IGNORECASE
)
ENDS = ("meta/episode_ends", "episode_ends")  # arrays with the end row (exclusive) of each recording
NAMES, LABELS = "recordings", "labels"  # attributes of the group: recording names, and labels by name


@dataclass(frozen=True)
class Episode:
    """One recording in a tree: its group, or its rows if arrays contain several recordings."""

    name: str | None  # None if the tree is one recording
    group: str = ""
    start: int = 0
    stop: int | None = None  # None for the end of each array
    number: int = 0  # index among the ``count`` recordings that share arrays
    count: int = 0
    total: int = 0  # number of rows of all recordings
    ends_group: str | None = None  # group of the array with the ends
    labels: StoredAttributes = field(default_factory=dict)
    name_is_stated: bool = False  # whether the file contains the name

    def inside(self, path: str) -> str:
        """Return the path of a group or array in the recording's group."""
        return path[len(self.group) :].strip("/")


def find_episodes(tree: Tree) -> list[Episode]:
    """Return the recordings of a tree in natural order of their names; one unnamed recording for an undivided tree.

    Recordings are divided by an array of their end rows, or are numbered groups. Raises `TacpipeError` if the ends do
    not divide the arrays.
    """
    episodes = _episodes_from_ends(tree)
    if episodes:
        return episodes
    groups: list[str] = []
    for group in tree.members("")[1]:  # the groups of recordings are here or one level below
        groups += [group] if _is_numbered(group) else filter(_is_numbered, tree.members(group)[1])
    if not groups:
        return [Episode(None)]
    names = Counter(group.rpartition("/")[2] for group in groups)
    return [Episode(_episode_name(group, names), group) for group in sorted(groups, key=natural_order)]


def _is_numbered(group: str) -> bool:
    return NUMBERED.fullmatch(group.rpartition("/")[2]) is not None


def _episode_name(group: str, names: Mapping[str, int]) -> str:
    """Return the name of a recording's group, with its parent's name if the last part is ambiguous."""
    last = group.rpartition("/")[2]
    return last if names[last] == 1 else group


def find_episode(tree: Tree, name: str | None) -> Episode:
    """Return the recording with this name, or the only one for None, without reading the others.

    Raises `TacpipeError` if there is no such recording.
    """
    if name is None:
        (*others, episode) = find_episodes(tree)
        if others or episode.name is not None:
            raise TacpipeError(f"{tree.path} holds {len(others) + 1} recordings. Name one of them.")
        return episode
    delimited = _episodes_from_ends(tree)
    for episode in delimited:
        if episode.name == name:
            return episode
    if not delimited:
        for group in ["", *(tree.members("")[1] if "/" not in name else ())]:
            path = f"{group}/{name}" if group else name
            if tree.is_group(path):
                return Episode(name, path)
    raise TacpipeError(f"{tree.path} holds no recording {plain(name)}.")


def _episodes_from_ends(tree: Tree) -> list[Episode]:
    """Return the recordings delimited by an array of their end rows; an empty list if the tree has no such array."""
    for path in ENDS:
        group = path.rpartition("/")[0]
        array = (
            next((array for array in tree.members(group)[0] if array.path == path), None)
            if tree.is_group(group)
            else None
        )
        if array is not None:
            ends = [int(end) for end in _read_ends(tree, array)]
            attributes = tree.attributes(group)
            names, has_names = attributes.get(NAMES), True
            if not isinstance(names, list) or len({str(name) for name in names}) != len(ends):
                names = [f"episode_{number:06d}" for number in range(len(ends))]  # names in LeRobot's style
                has_names = False
            labels = attributes.get(LABELS)
            return [
                Episode(
                    name=str(name),
                    start=start,
                    stop=stop,
                    number=number,
                    count=len(ends),
                    total=ends[-1],
                    ends_group=group,
                    labels=_labels_of_episode(labels, str(name)),
                    name_is_stated=has_names,
                )
                for number, (name, start, stop) in enumerate(zip(names, [0, *ends], ends, strict=False))
            ]
    return []


def _labels_of_episode(labels: Any, name: str) -> StoredAttributes:
    values = labels.get(name) if isinstance(labels, dict) else None
    return values if isinstance(values, dict) else {}


def _read_ends(tree: Tree, array: ArrayDescription) -> AnyArray:
    """Return the end rows of recordings. Raises `TacpipeError` if the array cannot be read or does not increase."""
    if array.problem:
        raise TacpipeError(f"{tree.path}: {array.path} {array.problem}.")
    if len(array.shape) != 1 or array.dtype.kind not in "iu":
        raise TacpipeError(
            f"{tree.path}: {array.path} must be whole numbers, one a recording; it has the shape {array.shape}."
        )
    memory.require_block(array.row_bytes * array.shape[0], f"{tree.path}: {array.path}")
    ends = np.asarray(tree.read(array, 0, array.shape[0]))
    steps = np.diff(ends.astype(np.int64), prepend=0)
    if (steps < 1).any():
        row = int((steps < 1).argmax())
        raise TacpipeError(
            f"{tree.path}: {array.path} must rise from one recording to the next; row {row + 1} holds {ends[row]}"
            f"{f', the one before {ends[row - 1]}' if row else ''}."
        )
    return ends


TIME = re.compile(
    r"(t|time|times|timestamps?|time_?stamps?|stamps?|clock|unix_?time|epoch)(_?(s|sec|seconds|ms|us|ns))?",
    re.IGNORECASE,
)
SENSOR_TIME = re.compile(r"\w+_(time_?stamps?|stamps?|time)(_?(s|sec|seconds|ms|us|ns))?", re.IGNORECASE)
LENGTHS = "compress_len"  # ALOHA: frame lengths before padding
NEXT = "next_obs"  # robomimic: ``obs``, one step later
ROOT = "/"  # source of arrays in the recording's own group


@dataclass(frozen=True)
class StreamArrays:
    """The arrays of one stream. ``source`` is its name in the recording, ``time`` its array of timestamps."""

    source: str
    arrays: Sequence[ArrayDescription]
    time: ArrayDescription | None
    frames: bool = False  # whether its only array contains images
    filled: int | None = None  # number of rows up to the last stamp that was written; None for all rows

    @property
    def all_arrays(self) -> Sequence[ArrayDescription]:
        """The arrays including the timestamps."""
        return [*([] if self.time is None else [self.time]), *self.arrays]

    @property
    def clock(self) -> str:
        """The column of timestamps: an array, or a field of a compound array; empty if there is none."""
        if self.time is not None:
            return self.time.name
        kind = self.arrays[0].dtype
        return next((name for name in kind.names or () if TIME.fullmatch(name) and kind[name].kind in "iuf"), "")


@dataclass(frozen=True)
class StreamParts:
    """The streams of a recording, its arrays with one value, and the skipped arrays with reasons."""

    parts: Sequence[StreamArrays]
    scalars: Sequence[ArrayDescription] = ()
    skipped: Mapping[str, str] = field(default_factory=dict)
    unused_stamps: Sequence[ArrayDescription] = ()  # arrays of stamps with another length than all arrays beside them


def group_into_parts(tree: Tree, episode: Episode) -> StreamParts:
    """Group the arrays of a recording into streams, in the file's order.

    Arrays that are neither streams nor skipped are single values of the recording.
    """
    parts: list[StreamArrays] = []
    scalars: list[ArrayDescription] = []
    skipped: dict[str, str] = {}
    # timestamps in parent groups, used for arrays of the same length without their own
    parent_stamps: list[ArrayDescription] = []
    for group, arrays in walk(tree, episode.group):
        relative_group = episode.inside(group)
        if relative_group.rpartition("/")[2] == NEXT:
            skipped[relative_group] = "repeats obs, one step later"
        columns_of_group: list[ArrayDescription] = []
        for array in arrays:
            reason = _reason_left_out(array, episode)
            if NEXT in relative_group.split("/"):
                continue
            if reason:
                skipped[episode.inside(array.path)] = reason
            elif group == episode.ends_group and array.shape == (episode.count,):
                scalars += [array] if array.path not in ENDS else []
            else:
                (columns_of_group if _is_column(array, arrays, episode) else scalars).append(array)
        parts += _divide_by_length(columns_of_group, relative_group or ROOT, episode, parent_stamps)
        parent_stamps += filter(_is_time, columns_of_group)
    used = [array for part in parts for array in part.all_arrays]
    unused = [array for array in parent_stamps if array not in used]
    for array in unused:
        skipped[episode.inside(array.path)] = f"has {array.shape[0]} stamps, and no array beside it has as many rows"
    filled_parts = [replace(part, filled=_filled_rows(tree, episode, part)) for part in parts]
    return StreamParts(filled_parts, scalars, skipped, unused)


def has_no_stamp(tree: Tree, episode: Episode, part: StreamArrays) -> bool:
    """Return whether a stream has an array of timestamps, and it was never written."""
    rows = row_count(episode, part)
    if not part.clock or rows < 2:
        return False
    return not any(np.nan_to_num(_stamps(tree, episode, part, row, row + 1)).any() for row in (0, rows // 2, rows - 1))


def _filled_rows(tree: Tree, episode: Episode, part: StreamArrays) -> int:
    """Return the number of rows up to the last stamp that was written.

    Stamps after it are NaN, or one number that is smaller, such as the 0 of an array that was created with its full size.
    """
    rows = row_count(episode, part)
    if not part.clock or rows < 2:
        return rows
    (first,), (last,) = (_stamps(tree, episode, part, row, row + 1) for row in (0, rows - 1))
    if last > first:
        return rows
    stamps = _stamps(tree, episode, part, 0, rows)
    filled_rows = np.flatnonzero(~(np.isnan(stamps) | (stamps == last)))
    filled = int(filled_rows[-1]) + 1 if len(filled_rows) else rows
    return filled if np.isnan(last) or stamps[filled - 1] > last else rows


def _reason_left_out(array: ArrayDescription, episode: Episode) -> str:
    """Return the reason why an array is skipped, or an empty string."""
    if array.name == LENGTHS:
        return "holds the lengths of padded frames"
    is_one_per_recording = array.group == episode.ends_group and array.shape == (episode.count,)
    if reason := reason_left_out(array):
        return reason
    if episode.stop is not None and not is_one_per_recording and array.shape[:1] < (episode.total,):
        return f"has {array.shape[0] if array.shape else 1} rows, fewer than its recordings"
    return ""


def _is_column(array: ArrayDescription, neighbours: Sequence[ArrayDescription], episode: Episode) -> bool:
    """Return whether an array has one value per row rather than one per recording."""
    lengths = {neighbour.shape[0] for neighbour in neighbours if neighbour.shape}
    return bool(array.shape) and (array.shape != (1,) or lengths == {1} or episode.stop is not None)


def _divide_by_length(
    arrays: Sequence[ArrayDescription], group: str, episode: Episode, parent_clocks: Sequence[ArrayDescription]
) -> Iterator[StreamArrays]:
    """Yield one stream per array length, and one per array of images or of structures.

    A group's only stream has the name of the group, other streams that of their first array. ``parent_clocks`` are the
    arrays of timestamps in parent groups.
    """
    single_streams = [
        array
        for array in arrays
        if array.dtype.kind == "V" or pixel_format(array) or (is_frames(array) and "quantity" not in array.attributes)
    ]
    by_length: dict[int, list[ArrayDescription]] = {}
    for array in arrays:
        if array not in single_streams:
            by_length.setdefault(array.shape[0], []).append(array)
    is_divided = sum(any(not _is_time(array) for array in same_length) for same_length in by_length.values()) > 1
    for same_length in by_length.values():
        time = _clock_array(same_length, parent_clocks)
        columns = [array for array in same_length if array is not time]
        if columns:
            named_by_array = is_divided or (group == ROOT and len(columns) == 1)
            yield StreamArrays(episode.inside(columns[0].path) if named_by_array else group, columns, time)
    for array in single_streams:
        time = _clock_array(
            by_length.get(array.shape[0], []), [clock for clock in parent_clocks if clock.shape[0] == array.shape[0]]
        )
        is_picture = is_frames(array) or pixel_format(array) is not None
        yield StreamArrays(episode.inside(array.path), [array], time, is_picture)


def _clock_array(
    same_length: Sequence[ArrayDescription], parent_clocks: Sequence[ArrayDescription]
) -> ArrayDescription | None:
    """Return the timestamps for arrays of one length: one of them, or an array in a parent group; None if there are none."""
    clocks = [array for array in same_length if _is_time(array)]
    clock = next((array for array in clocks if TIME.fullmatch(array.name)), next(iter(clocks), None))
    length = same_length[0].shape[0] if same_length else None
    return clock or next(
        (array for array in reversed(parent_clocks) if length is None or array.shape[0] == length), None
    )


def _is_time(array: ArrayDescription) -> bool:
    """Return whether an array contains timestamps, by its name, shape and type."""
    is_column = len(array.shape) == 1 or array.shape[1:] == (1,)
    return (
        is_column
        and array.dtype.kind in "iuf"
        and (TIME.fullmatch(array.name) is not None or SENSOR_TIME.fullmatch(array.name) is not None)
    )


RATES = ("rate_hz", "fps", "frequency_hz", "frequency", "control_freq", "sampling_rate", "sample_rate", "rate", "hz")


def time_of_part(tree: Tree, episode: Episode, part: StreamArrays) -> Time:
    """Return how a stream is timed: by a column of timestamps or a rate, or an empty `Time` if the file has neither."""
    if part.clock:
        size = _last_stamp(tree, episode, part)
        unit = _stamp_unit(part, size)
        if unit is not None:
            declared = part.time is not None and part.time.attributes.get("quantity") == "time"
            since_1970 = declared or size >= stamps.MIN_UNIX_S * 10 ** (9 - stamps.DIGITS[unit])
            return Time(column=part.clock, unit=unit, origin="unix" if since_1970 else "start")
    rate = declared_rate_hz(tree, episode, part)
    return Time() if rate is None else Time(rate_hz=rate)


def row_count(episode: Episode, part: StreamArrays) -> int:
    """Return the number of rows of a stream in a recording."""
    length = part.arrays[0].shape[0]
    rows = max((length if episode.stop is None else min(episode.stop, length)) - episode.start, 0)
    return rows if part.filled is None else part.filled


def parent_groups(group: str) -> list[str]:
    """Return a group and its parents, the root first.

    >>> parent_groups("data/demo_0")
    ['', 'data', 'data/demo_0']
    """
    names = group.split("/") if group else []
    return ["/".join(names[:count]) for count in range(len(names) + 1)]


def _last_stamp(tree: Tree, episode: Episode, part: StreamArrays) -> float:
    """Return the absolute value of a stream's last stored timestamp, or 0 if there is none."""
    rows = row_count(episode, part)
    values = _stamps(tree, episode, part, max(rows - 1, 0), rows)
    return abs(float(values[0])) if len(values) and np.isfinite(values[0]) else 0.0


def _stamps(tree: Tree, episode: Episode, part: StreamArrays, start: int, stop: int) -> AnyArray:
    """Return the stored timestamps of the rows ``start`` to ``stop`` (exclusive) of a recording (row,)."""
    values = np.asarray(tree.read(part.time or part.arrays[0], episode.start + start, episode.start + stop))
    return (values if part.time is not None else values[part.clock]).reshape(-1)


def _stamp_unit(part: StreamArrays, size: float) -> TimeUnit | None:
    """Return the unit of timestamps from an attribute, the name or the magnitude; None if it is unknown.

    ``size`` is the absolute value of a timestamp.
    """
    attributes = part.time.attributes if part.time is not None else {}
    declared = next((str(attributes[key]) for key in ("unit", "units") if isinstance(attributes.get(key), str)), "")
    suffix = re.search(r"_(ns|us|ms|s|sec|seconds)$", part.clock, re.IGNORECASE)
    texts = [declared.replace("µ", "u"), suffix[1] if suffix else ""]
    units = (schema.unit_from_text(text.lower()) for text in texts)
    stated = next((cast("TimeUnit", unit) for unit in units if unit in stamps.DIGITS), None)
    return stated or stamps.unit_of_unix_time(size)


def declared_rate_hz(tree: Tree, episode: Episode, part: StreamArrays | None) -> float | None:
    """Return the rate declared by a stream's arrays, its group, a parent group, or all recordings; None if there is none."""
    arrays = part.arrays if part is not None else ()
    groups = [*reversed(parent_groups(arrays[0].group))] if arrays else []
    attribute_sets = [*(array.attributes for array in arrays), *map(tree.attributes, groups)]
    attribute_sets += [tree.attributes(episode.ends_group)] if episode.ends_group is not None else []
    return next((rate for attributes in attribute_sets if (rate := _declared_rate(attributes)) is not None), None)


def _declared_rate(attributes: StoredAttributes) -> float | None:
    """Return the rate in Hz in the attributes of an array or group, or None if they have none."""
    for name in RATES:
        value = attributes.get(name)
        if isinstance(value, int | float | np.number) and np.isfinite(value) and 0 < value <= 1e9:
            return float(value)
    environment = attributes.get("env_args")  # robomimic: a text of JSON
    inner = json_object(environment).get("env_kwargs") if isinstance(environment, str | bytes) else None
    return _declared_rate({"control_freq": inner.get("control_freq")}) if isinstance(inner, dict) else None
