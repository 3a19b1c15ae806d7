"""HDF5 files and Zarr stores as containers of streams (`tacpipe.formats.containers.container`)."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from tacpipe.arrays import AnyArray
from tacpipe.formats.arrays import columns, episodes, frames, known, parts, times
from tacpipe.formats.arrays.episodes import Episode
from tacpipe.formats.arrays.parts import Part
from tacpipe.formats.arrays.tree import LONGEST_TEXT, Tree, is_text, plain_attributes
from tacpipe.formats.containers import kinds
from tacpipe.formats.containers.container import Batched, Contents, Share, SourceStream
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import plain

ROWS = 3  # that a look reads
BLOCK_BYTES = 1 << 25  # that are read at once, or a chunk of the file where that is more
OBJECT_BYTES = 200  # that a text may take in memory
MASK = "mask"  # the group of robomimic's lists
DEPTH = 4  # of texts of JSON in attributes
RowsOf = Callable[[Tree, Episode, Part], "pa.Table | Batched"]


@dataclass(frozen=True)
class ArrayContainer:
    """A file of arrays; ``open_tree`` opens it."""

    path: Path
    open_tree: Callable[[], AbstractContextManager[Tree]]

    def episodes(self) -> Sequence[str]:
        """Return the names of the recordings inside, none where the whole is one."""
        with self.open_tree() as tree:
            return [one.name for one in episodes.found(tree) if one.name is not None]

    @property
    def names_itself(self) -> bool:
        """Whether the file states the names of its recordings."""
        with self.open_tree() as tree:
            return all(one.stated for one in episodes.found(tree))

    def look(self, episode: str | None) -> Contents:
        """Return the streams of a recording with their first rows."""
        with self.open_tree() as tree:
            return _contents(tree, episodes.named(tree, episode), None, _first_rows)

    def read(self, sources: Collection[str] | None, episode: str | None) -> Contents:
        """Return the streams of a recording, all or those of some sources; of long ones the rows stay in the file."""
        with self.open_tree() as tree:
            return _contents(tree, episodes.named(tree, episode), sources, self._rows)

    def _rows(self, tree: Tree, episode: Episode, part: Part) -> pa.Table | Batched:
        """Return the rows of a stream, block by block from the file where they are more than one block."""
        start, count = episode.start, times.rows(episode, part)
        step = _block_rows(tree, episode, part)
        edges = [start, *range((start // step + 1) * step, start + count, step), start + count]
        first = _table(tree, episode, part, edges[0], edges[1])
        if len(edges) == 2:
            return first
        schema = first.schema

        def read() -> Iterator[pa.Table]:
            with self.open_tree() as again:
                for begin, end in itertools.pairwise(edges):
                    yield pa.table(_table(again, episode, part, begin, end).columns, schema)

        return Batched(schema, count, read)

    def share(self, sources: Collection[str] | None, episode: str | None) -> Share | None:
        """Return the chunks that a recording is read from, and what metadata state of it; None of a single file."""
        with self.open_tree() as tree:
            one = episodes.named(tree, episode)
            found = parts.of(tree, one)
            wanted = [part for part in found.parts if sources is None or part.source in sources]
            arrays = [*found.scalars, *(array for part in wanted for array in part.all)]
            files: dict[str, Path] = {}
            for array in arrays:
                chunks = tree.files(
                    array, one.start, array.shape[0] if one.stop is None and array.shape else one.stop or 1
                )
                if chunks is None:
                    return None
                files |= chunks
            stated: dict[str, Any] = {array.path: [tree.stated(array), dict(array.attributes)] for array in arrays}
            attributes: dict[str, Any] = {group: dict(tree.attributes(group)) for group in times.above(one.group)}
            rows = [one.start, one.stop]
            return Share(
                files, {"rows": rows, "arrays": stated, "attributes": attributes, "skipped": dict(found.skipped)}
            )


def _contents(tree: Tree, episode: Episode, sources: Collection[str] | None, rows: RowsOf) -> Contents:
    found = parts.of(tree, episode)
    skipped = dict(found.skipped)
    attributes, long = _attributes(tree, episode)
    for one in found.scalars:
        row = episode.number if one.shape else 0
        name = one.name if one.group == episode.beside else episode.inside(one.path).replace("/", ".")
        attributes |= plain_attributes({name: tree.read(one, row, row + 1)})
    attributes |= {**plain_attributes(episode.labels), **_masks(tree, episode)}
    skipped |= long
    kept = []
    for part in found.parts:
        if part.frames and times.rows(episode, part) and not frames.encoded(tree, part.arrays[0], episode.start):
            skipped[part.source] = "holds pictures that are not encoded as JPEG, PNG or WebP, which are not read"
        else:
            kept.append(part)
    timed = [(part, times.of(tree, episode, part)) for part in kept]
    chosen = [(part, time) for part, time in timed if (part.source in sources if sources is not None else True)]
    if sources is None and any(time.given for _, time in chosen):
        for part, time in chosen:
            if not time.given:
                skipped[part.source] = "has no stamps and no rate; a layout that names it gives them"
        chosen = [(part, time) for part, time in chosen if time.given]
    names = _names(kept)
    streams = [
        SourceStream(
            part.source,
            names[part.source],
            time,
            rows(tree, episode, part),
            times.rows(episode, part),
        )
        for part, time in chosen
    ]
    return Contents(streams, attributes, skipped, tree.notes)


def _masks(tree: Tree, episode: Episode) -> dict[str, Attribute]:
    """Return in which lists of recordings (``mask/train``, ``mask/valid`` of robomimic) one is, by name."""
    if not episode.group or not tree.is_group(MASK):
        return {}
    lists = [one for one in tree.members(MASK)[0] if is_text(one) and len(one.shape) == 1]
    return {f"{MASK}.{one.name}": episode.name in _texts(tree.read(one, 0, one.shape[0])) for one in lists}


def _texts(values: AnyArray) -> set[str]:
    return {one.decode(errors="replace") if isinstance(one, bytes) else str(one) for one in values.tolist()}


def _names(found: Sequence[Part]) -> dict[str, str]:
    """Return a name for each stream by its source: the last part of it where no other has the same."""
    last = [part.source.rpartition("/")[2] for part in found]
    root = "steps" if "steps" not in last else parts.ROOT
    called = {
        part.source: root if part.source == parts.ROOT else name if last.count(name) == 1 else part.source
        for part, name in zip(found, last, strict=True)
    }
    names = kinds.identifiers(list(called.values()))
    return {source: names[name] for source, name in called.items()}


def _first_rows(tree: Tree, episode: Episode, part: Part) -> pa.Table:
    return _table(tree, episode, part, episode.start, episode.start + min(times.rows(episode, part), ROWS))


def _block_rows(tree: Tree, episode: Episode, part: Part) -> int:
    """Return how many rows of a stream are read at once: whole chunks, since a file gives no less."""
    row_bytes = sum(array.row_bytes + (OBJECT_BYTES if array.dtype.hasobject else 0) for array in part.all)
    if part.frames and times.rows(episode, part):
        row_bytes += frames.size(tree, part.arrays[0], episode.start)
    rows = max(1, BLOCK_BYTES // row_bytes)
    chunk_rows = max(array.chunk_rows for array in part.all)
    return -(-rows // chunk_rows) * chunk_rows if chunk_rows else rows


def _table(tree: Tree, episode: Episode, part: Part, start: int, stop: int) -> pa.Table:
    fields: list[pa.Field] = []
    values: list[pa.Array] = []
    is_aloha = tree.is_group(f"{episode.group}/observations".strip("/"))
    for array in part.all:
        if part.frames and array is not part.time:
            made = [frames.of(array, tree.read(array, start, stop))]
        else:
            about = known.aloha(array.name, array.shape[-1]) if is_aloha and len(array.shape) == 2 else None
            made = list(columns.of(tree, array, start, stop, about))
        fields += [field for field, _ in made]
        values += [column for _, column in made]
    return pa.table(values, pa.schema(fields))


def _attributes(tree: Tree, episode: Episode) -> tuple[dict[str, Attribute], dict[str, str]]:
    """Return the attributes of a recording's group and those above, and which texts are too long for one."""
    made: dict[str, Attribute] = {}
    long: dict[str, str] = {}
    for group in times.above(episode.group):
        for name, value in tree.attributes(group).items():
            text = value.decode(errors="replace") if isinstance(value, bytes) else value
            inner = _flat(text)
            made |= plain_attributes({f"{name}.{key}": one for key, one in inner.items()} if inner else {name: value})
            if isinstance(text, str) and len(text) > LONGEST_TEXT and not inner:
                long[f"attribute {plain(name)}"] = f"is a text of {len(text)} characters, too long for a label"
    return made, long


def _flat(text: Any) -> dict[str, Any]:
    """Return what a text of JSON states, with dots between the names; nothing where it is none.

    >>> _flat('{"env_name": "Lift", "env_kwargs": {"control_freq": 20}}')
    {'env_name': 'Lift', 'env_kwargs.control_freq': 20}
    """
    if not isinstance(text, str) or not text.startswith("{"):
        return {}
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return dict(_leaves(found))


def _leaves(value: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for name, one in value.items():
        if isinstance(one, dict) and before.count(".") < DEPTH:
            yield from _leaves(one, f"{before}{name}.")
        else:
            yield f"{before}{name}", one
