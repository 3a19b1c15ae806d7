"""Read HDF5 files and Zarr stores as containers of streams (`tacpipe.formats.container`)."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pyarrow as pa

from tacpipe.arrays import AnyArray
from tacpipe.formats import container
from tacpipe.formats.arrays import episodes, zarr
from tacpipe.formats.arrays.episodes import Episode, StreamArrays
from tacpipe.formats.arrays.tree import (
    MAX_TEXT,
    ArrayDescription,
    StoredAttributes,
    Tree,
    columns_of_array,
    first_picture,
    is_text,
    picture_column,
    pixel_format,
    plain_attributes,
)
from tacpipe.formats.container import Batched, Container, EpisodeContents, Share, SourceStream, Time
from tacpipe.formats.table import column_names
from tacpipe.plugins import extras
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import listed, plain
from tacpipe.video.images import picture_encoding

LOOK_ROWS = 3  # number of rows read by `ArrayContainer.look`
BLOCK_BYTES = 1 << 25  # number of bytes read at once; larger chunks of a file are read completely
OBJECT_BYTES = 200  # assumed size of a string in memory
UNFILLED = "without a stamp"  # reason why rows are not used
MASK = "mask"  # group with robomimic's lists of recordings
MAX_DEPTH = 4  # maximum depth of JSON in attributes
RowsOf = Callable[[Tree, Episode, StreamArrays], "pa.Table | Batched"]


@dataclass(frozen=True)
class ArrayContainer(Container):
    """A file of arrays that ``open_tree`` opens."""

    path: Path
    open_tree: Callable[[], AbstractContextManager[Tree]]

    def episodes(self) -> Sequence[str]:
        """Return the names of the recordings in the file, or None if the file is one recording."""
        with self.open_tree() as tree:
            return [episode.name for episode in episodes.find_episodes(tree) if episode.name is not None]

    @property
    def names_itself(self) -> bool:
        """Whether the file contains the names of its recordings."""
        with self.open_tree() as tree:
            return all(episode.name_is_stated for episode in episodes.find_episodes(tree))

    def look(self, episode: str | None) -> EpisodeContents:
        """Return the streams of a recording with their first rows."""
        with self.open_tree() as tree:
            return _read_contents(tree, episodes.find_episode(tree, episode), None, _first_rows)

    def read(self, sources: Collection[str] | None, episode: str | None) -> EpisodeContents:
        """Return the streams of a recording, optionally only those of ``sources``. Rows of long streams are read later."""
        with self.open_tree() as tree:
            return _read_contents(tree, episodes.find_episode(tree, episode), sources, self._rows)

    def _rows(self, tree: Tree, episode: Episode, part: StreamArrays) -> pa.Table | Batched:
        """Return the rows of a stream of a recording: a table, or several blocks that are read when needed."""
        start, count = episode.start, episodes.row_count(episode, part)
        step = _block_rows(tree, episode, part)
        edges = [start, *range((start // step + 1) * step, start + count, step), start + count]
        first = _rows_table(tree, episode, part, edges[0], edges[1])
        if len(edges) == 2:
            return first
        schema = first.schema

        def read() -> Iterator[pa.Table]:
            with self.open_tree() as reopened:
                for begin, end in itertools.pairwise(edges):
                    yield pa.table(_rows_table(reopened, episode, part, begin, end).columns, schema)

        return Batched(schema, count, read)

    def share(self, sources: Collection[str] | None, episode: str | None) -> Share | None:
        """Return the chunks and metadata that a recording is read from, or None for a single file."""
        with self.open_tree() as tree:
            array_episode = episodes.find_episode(tree, episode)
            contents = episodes.group_into_parts(tree, array_episode)
            selected = [part for part in contents.parts if sources is None or part.source in sources]
            arrays = [*contents.scalars, *(array for part in selected for array in part.all_arrays)]
            files: dict[str, Path] = {}
            for array in arrays:
                stop = array_episode.stop or (array.shape[0] if array.shape else 1)
                chunks = tree.files(array, array_episode.start, stop)
                if chunks is None:
                    return None
                files |= chunks
            array_metadata = {array.path: [tree.encoding_metadata(array), dict(array.attributes)] for array in arrays}
            attributes = {group: dict(tree.attributes(group)) for group in episodes.parent_groups(array_episode.group)}
            rows = [array_episode.start, array_episode.stop]
            return Share(
                files,
                {"rows": rows, "arrays": array_metadata, "attributes": attributes, "skipped": dict(contents.skipped)},
            )


def open_hdf5(path: Path) -> ArrayContainer:
    """Return the container of an HDF5 file. Raises `MissingModuleError` if h5py is not installed."""
    with extras.explain_missing("Reading HDF5"):
        from tacpipe.formats.arrays import hdf5
    return ArrayContainer(path, lambda: hdf5.open_hdf5(path))


def open_zarr(path: Path) -> ArrayContainer:
    """Return the container of a Zarr store. Raises `MissingModuleError` if zarr is not installed."""
    extras.require("Reading Zarr", "zarr")
    return ArrayContainer(path, lambda: zarr.open_zarr(path))


def _read_contents(tree: Tree, episode: Episode, sources: Collection[str] | None, rows: RowsOf) -> EpisodeContents:
    """Return the streams, attributes and skipped arrays of a recording. ``rows`` returns the rows of a stream.

    If ``sources`` is None, streams with neither timestamps nor a rate are skipped if another stream has either.
    """
    contents = episodes.group_into_parts(tree, episode)
    skipped = dict(contents.skipped)
    attributes, long_texts = _read_attributes(tree, episode)
    for scalar in contents.scalars:
        row = episode.number if scalar.shape else 0
        name = scalar.name if scalar.group == episode.ends_group else episode.inside(scalar.path).replace("/", ".")
        attributes |= plain_attributes({name: tree.read(scalar, row, row + 1)})
    attributes |= {**plain_attributes(episode.labels), **_masks(tree, episode)}
    skipped |= long_texts
    parts_read = []
    for part in contents.parts:
        array, is_empty = part.arrays[0], not episodes.row_count(episode, part)
        if (
            part.frames
            and not is_empty
            and not pixel_format(array)
            and not picture_encoding(first_picture(tree, array, episode.start))
        ):
            skipped[part.source] = "holds pictures that are not encoded as JPEG, PNG or WebP, which are not read"
        else:
            parts_read.append(part)
    parts_and_times = [(part, episodes.time_of_part(tree, episode, part)) for part in parts_read]
    selected = [(part, time) for part, time in parts_and_times if sources is None or part.source in sources]
    problems = {
        part.source: problem
        for part, time in selected
        if not time.is_declared and (problem := _stamp_problem(tree, episode, part, contents.unused_stamps))
    }
    if sources is None and (problems or any(time.is_declared for _, time in selected)):
        for part, time in selected:
            if not time.is_declared:
                problem = problems.get(part.source, "has no stamps and no rate")
                skipped[part.source] = f"{problem}; a layout that names it and its rate reads it"
        selected = [(part, time) for part, time in selected if time.is_declared]
    names = _stream_names(parts_read)
    notes = [f"{tree.path}: {note}" for note in _describe_lengths(episode, selected)]
    streams = [
        SourceStream(
            part.source,
            names[part.source],
            time,
            rows(tree, episode, part),
            episodes.row_count(episode, part),
            dropped={UNFILLED: _unfilled_rows(episode, part)} if _unfilled_rows(episode, part) else {},
        )
        for part, time in selected
    ]
    return EpisodeContents(streams, attributes, skipped, [*tree.notes, *notes])


def _stamp_problem(tree: Tree, episode: Episode, part: StreamArrays, unused: Sequence[ArrayDescription]) -> str:
    """Return why the stamps beside the arrays of a stream cannot be used, as a clause, or "" if there are none."""
    if episodes.has_no_stamp(tree, episode, part):
        return f"has stamps ({plain(part.clock)}) that were never written"
    stamps = next((array for array in unused if array.group == part.arrays[0].group), None)
    if stamps is None:
        return ""
    return f"has {episodes.row_count(episode, part):,} rows, and {plain(stamps.name)} {stamps.shape[0]:,}"


def _unfilled_rows(episode: Episode, part: StreamArrays) -> int:
    return episodes.row_count(episode, replace(part, filled=None)) - episodes.row_count(episode, part)


def _describe_lengths(episode: Episode, parts: Sequence[tuple[StreamArrays, Time]]) -> Iterator[str]:
    """Yield sentences about rows without stamps, and about streams of one rate that have different lengths."""
    lengths: dict[object, dict[int, list[str]]] = {}  # sources by number of rows, by rate, or else by group
    for part, time in parts:
        rows, unfilled = episodes.row_count(episode, part), _unfilled_rows(episode, part)
        if unfilled:
            yield (
                f"the last {unfilled:,} of {rows + unfilled:,} stamps of {plain(part.source)} ({plain(part.clock)}) were "
                f"never written; these rows are left out."
            )
        if not time.column:
            lengths.setdefault(time.rate_hz or part.arrays[0].group, {}).setdefault(rows, []).append(plain(part.source))
    for rate, sources in lengths.items():
        if len(sources) > 1:
            counts = "; ".join(f"{listed(names, 3)} {rows:,} rows" for rows, names in sources.items())
            yield (
                f"streams without stamps have different lengths: {counts}. All are read from their first row"
                f"{f', at {rate:g} Hz' if isinstance(rate, float) else ''}, so check that they start together."
            )


def _masks(tree: Tree, episode: Episode) -> dict[str, Attribute]:
    """Return for each list of recordings (robomimic's ``mask/train``, ``mask/valid``) whether it contains this recording."""
    if not episode.group or not tree.is_group(MASK):
        return {}
    lists = [mask for mask in tree.members(MASK)[0] if is_text(mask) and len(mask.shape) == 1]
    return {f"{MASK}.{mask.name}": episode.name in _decode_texts(tree.read(mask, 0, mask.shape[0])) for mask in lists}


def _decode_texts(values: AnyArray) -> set[str]:
    return {value.decode(errors="replace") if isinstance(value, bytes) else str(value) for value in values.tolist()}


def _stream_names(parts_read: Sequence[StreamArrays]) -> dict[str, str]:
    """Return a name for each stream by its source: the last part of the path if that is unique, else the path.

    The recording's own group is named ``steps``.
    """
    last = [part.source.rpartition("/")[2] for part in parts_read]
    root = "steps" if "steps" not in last else episodes.ROOT
    short_names = {}
    for part, name in zip(parts_read, last, strict=True):
        short_names[part.source] = name if last.count(name) == 1 else part.source
        if part.source == episodes.ROOT:
            short_names[part.source] = root
    names = container.identifiers(list(short_names.values()))
    return {source: names[name] for source, name in short_names.items()}


def _first_rows(tree: Tree, episode: Episode, part: StreamArrays) -> pa.Table:
    return _rows_table(
        tree, episode, part, episode.start, episode.start + min(episodes.row_count(episode, part), LOOK_ROWS)
    )


def _block_rows(tree: Tree, episode: Episode, part: StreamArrays) -> int:
    """Return the number of rows read at once. It covers whole chunks, because a file cannot read less."""
    row_bytes = sum(array.row_bytes + (OBJECT_BYTES if array.dtype.hasobject else 0) for array in part.all_arrays)
    if part.frames and episodes.row_count(episode, part) and not pixel_format(part.arrays[0]):
        row_bytes += len(first_picture(tree, part.arrays[0], episode.start))
    rows = max(1, BLOCK_BYTES // row_bytes)
    chunk_rows = max(array.chunk_rows for array in part.all_arrays)
    return -(-rows // chunk_rows) * chunk_rows if chunk_rows else rows


def _rows_table(tree: Tree, episode: Episode, part: StreamArrays, start: int, stop: int) -> pa.Table:
    """Return rows ``start`` to ``stop`` (exclusive) of a stream as a table with fields for each array."""
    fields: list[pa.Field] = []
    values: list[pa.Array] = []
    is_aloha = tree.is_group(f"{episode.group}/observations".strip("/"))
    for array in part.all_arrays:
        if part.frames and array is not part.time:
            array_columns = [picture_column(array, tree.read(array, start, stop))]
        else:
            meanings = (
                column_names.aloha_meanings(array.name, array.shape[-1]) if is_aloha and len(array.shape) == 2 else None
            )
            array_columns = list(columns_of_array(tree, array, start, stop, meanings))
        fields += [field for field, _ in array_columns]
        values += [column for _, column in array_columns]
    return pa.table(values, pa.schema(fields))


def _read_attributes(tree: Tree, episode: Episode) -> tuple[dict[str, Attribute], dict[str, str]]:
    """Return the attributes of a recording's group and its parents, and for attributes that were left out, the reason.

    A JSON object in a text becomes one attribute per value. Texts that are too long for an attribute are left out.
    """
    attributes: dict[str, Attribute] = {}
    left_out: dict[str, str] = {}
    for group in episodes.parent_groups(episode.group):
        for name, value in tree.attributes(group).items():
            text = value.decode(errors="replace") if isinstance(value, bytes) else value
            inner = _flatten_json(text)
            attributes |= plain_attributes(
                {f"{name}.{key}": inner_value for key, inner_value in inner.items()} if inner else {name: value}
            )
            if isinstance(text, str) and len(text) > MAX_TEXT and not inner:
                left_out[f"attribute {plain(name)}"] = f"is a text of {len(text)} characters, too long for a label"
    return attributes, left_out


def _flatten_json(text: Any) -> StoredAttributes:
    """Return the values of a JSON object in a text, with dotted names; an empty dictionary for other text.

    >>> _flatten_json('{"env_name": "Lift", "env_kwargs": {"control_freq": 20}}')
    {'env_name': 'Lift', 'env_kwargs.control_freq': 20}
    """
    is_object = isinstance(text, str) and text.startswith("{")
    return container.flatten(container.json_object(text), max_depth=MAX_DEPTH) if is_object else {}
