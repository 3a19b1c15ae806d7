"""Which arrays of a recording are one stream: those of one group and one length, with the stamps that lie beside them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from tacpipe.formats.arrays import episodes
from tacpipe.formats.arrays.episodes import Episode
from tacpipe.formats.arrays.tree import Array, Tree, is_frames, left_out, walk

TIME = re.compile(
    r"(t|time|times|timestamps?|time_?stamps?|stamps?|clock|unix_?time|epoch)(_?(s|sec|seconds|ms|us|ns))?",
    re.IGNORECASE,
)
SENSOR_TIME = re.compile(r"\w+_(time_?stamps?|stamps?|time)(_?(s|sec|seconds|ms|us|ns))?", re.IGNORECASE)
LENGTHS = "compress_len"  # of ALOHA's frames before they were padded
NEXT = "next_obs"  # of robomimic: obs, one step later
ROOT = "/"  # the source of arrays that lie in the recording's own group


@dataclass(frozen=True)
class Part:
    """The arrays of one stream: ``source`` names it within the recording, ``time`` is the array of its stamps."""

    source: str
    arrays: Sequence[Array]
    time: Array | None
    frames: bool = False  # whether its one array holds encoded pictures

    @property
    def all(self) -> Sequence[Array]:
        """The arrays with that of the stamps."""
        return [*([] if self.time is None else [self.time]), *self.arrays]

    @property
    def clock(self) -> str:
        """The column with the stamps: an array, or a field of a compound one; empty where there is none."""
        if self.time is not None:
            return self.time.name
        kind = self.arrays[0].dtype
        return next((name for name in kind.names or () if TIME.fullmatch(name) and kind[name].kind in "iuf"), "")


@dataclass(frozen=True)
class Found:
    """The streams of a recording, arrays of one value, and what is left out with the reason."""

    parts: Sequence[Part]
    scalars: Sequence[Array] = ()
    skipped: Mapping[str, str] = field(default_factory=dict)


def of(tree: Tree, episode: Episode) -> Found:
    """Return the streams of a recording, in the order of the file."""
    parts: list[Part] = []
    scalars: list[Array] = []
    skipped: dict[str, str] = {}
    stamps: list[Array] = []  # of groups above, for arrays of their length without stamps of their own
    for group, every in walk(tree, episode.group):
        inside = episode.inside(group)
        if inside.rpartition("/")[2] == NEXT:
            skipped[inside] = "repeats obs, one step later"
        there: list[Array] = []
        for array in every:
            reason = _reason(array, episode)
            if NEXT in inside.split("/"):
                continue
            if reason:
                skipped[episode.inside(array.path)] = reason
            elif group == episode.beside and array.shape == (episode.count,):
                scalars += [array] if array.path not in episodes.ENDS else []
            else:
                (there if _is_column(array, every, episode) else scalars).append(array)
        parts += _split(there, inside or ROOT, episode, stamps)
        stamps += filter(_is_time, there)
    return Found(parts, scalars, skipped)


def _reason(array: Array, episode: Episode) -> str:
    """Return why an array is left out; empty where it is not."""
    if array.name == LENGTHS:
        return "holds the lengths of padded frames"
    one_each = array.group == episode.beside and array.shape == (episode.count,)
    short = episode.stop is not None and not one_each and array.shape[:1] < (episode.total,)
    return left_out(array) or (
        f"has {array.shape[0] if array.shape else 1} rows, fewer than its recordings" if short else ""
    )


def _is_column(array: Array, beside: Sequence[Array], episode: Episode) -> bool:
    """Return whether an array has a value a row rather than one of the recording."""
    lengths = {one.shape[0] for one in beside if one.shape}
    return bool(array.shape) and (array.shape != (1,) or lengths == {1} or episode.stop is not None)


def _split(arrays: Sequence[Array], group: str, episode: Episode, above: Sequence[Array]) -> Iterator[Part]:
    """Yield the streams of one group's arrays, named by the group where it holds one, else by the first array of each."""
    apart = [one for one in arrays if one.dtype.kind == "V" or (is_frames(one) and "quantity" not in one.attributes)]
    by_length: dict[int, list[Array]] = {}
    for one in arrays:
        if one not in apart:
            by_length.setdefault(one.shape[0], []).append(one)
    several = sum(any(not _is_time(one) for one in same) for same in by_length.values()) > 1
    for same in by_length.values():
        time = _stamps(same, above)
        columns = [one for one in same if one is not time]
        if columns:
            alone = several or (group == ROOT and len(columns) == 1)
            yield Part(episode.inside(columns[0].path) if alone else group, columns, time)
    for one in apart:
        time = _stamps(by_length.get(one.shape[0], []), [each for each in above if each.shape[0] == one.shape[0]])
        yield Part(episode.inside(one.path), [one], time, is_frames(one))


def _stamps(same: Sequence[Array], above: Sequence[Array]) -> Array | None:
    """Return the array that holds the stamps of arrays of one length: among them, else in a group above."""
    clocks = [array for array in same if _is_time(array)]
    clock = next((array for array in clocks if TIME.fullmatch(array.name)), next(iter(clocks), None))
    length = same[0].shape[0] if same else None
    return clock or next((one for one in reversed(above) if length is None or one.shape[0] == length), None)


def _is_time(array: Array) -> bool:
    narrow = len(array.shape) == 1 or array.shape[1:] == (1,)
    return (
        narrow
        and array.dtype.kind in "iuf"
        and (TIME.fullmatch(array.name) is not None or SENSOR_TIME.fullmatch(array.name) is not None)
    )
