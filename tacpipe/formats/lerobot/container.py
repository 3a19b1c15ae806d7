"""LeRobot datasets as containers: one recording per episode, one stream per feature.

Frames have a constant rate. If ``timestamp`` agrees with ``frame_index / fps``, timestamps are that quotient, exact to
the nanosecond. Otherwise they are the float32 seconds of the column. The metadata of ``t_ns`` record which.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from tacpipe.arrays import Bools, Int64s
from tacpipe.errors import TacpipeError
from tacpipe.formats import container
from tacpipe.formats.container import Batched, Container, EpisodeContents, Share, SourceStream, Time
from tacpipe.formats.lerobot import description
from tacpipe.formats.lerobot.description import EpisodeDescription, FeatureDescription, LeRobotDescription
from tacpipe.formats.table.column_names import NO_MEANING, meaning_from_name, meanings
from tacpipe.io import files as file_system
from tacpipe.io import parquet, regular
from tacpipe.io.parquet import SOME_ROWS, ParquetTable
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import plain
from tacpipe.video.files import VideoScan, find_damage, packet_stream, read_packets, scan
from tacpipe.video.images import PICTURE
from tacpipe.video.stream import cut_rows

NATIVE = "tacpipe"  # folder with the original streams of an exported dataset, one folder per recording
TOLERANCE_S = 1e-4  # LeRobot's own tolerance
INDEX, FRAME, STAMP = "episode_index", "frame_index", "timestamp"
COUNTING_FEATURES = (INDEX, FRAME, STAMP, "index", "task_index")  # features that count frames
SHARED_STREAMS = ("next", NATIVE)  # features with these prefixes form one stream, such as next.reward and next.done
EXACT = f"{NATIVE}.t_ns"  # feature with the timestamps in ns of datasets exported by tacpipe
CLOCK = Time(column="t_ns", unit="ns", origin="start")
WRITE_AGAIN = "Write the episode again, or leave it out with --skip-bad."
FROM_RATE, FROM_STAMPS = "frame_index / fps", "timestamp, float32 seconds"


@functools.lru_cache(maxsize=4)  # episodes that share a video are read one after another
def _scan_video(path: Path, changed_ns: int) -> VideoScan:
    """Return the frames of a video; the result is cached until the file's modification time changes."""
    return scan(path)


class LeRobotContainer(Container):
    """A LeRobot dataset."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def episodes(self) -> Sequence[str]:
        """Return the names of the episodes by index."""
        return list(self._episodes)

    def look(self, episode: str | None) -> EpisodeContents:
        """Return the streams of an episode, without rows."""
        return self._contents(self._find_episode(episode), None, rows=False)

    def read(self, sources: Collection[str] | None, episode: str | None) -> EpisodeContents:
        """Return the streams of an episode, optionally only those of ``sources``."""
        return self._contents(self._find_episode(episode), sources, rows=True)

    @property
    def names_itself(self) -> bool:
        """Whether the episodes are named after the recordings that they were exported from."""
        return all(episode.original is not None for episode in self._episodes.values())

    def share(self, sources: Collection[str] | None, episode: str | None) -> Share:
        """Return the file, the native streams and the metadata that an episode is read from."""
        entry = self._find_episode(episode)
        dataset = self._about
        native_streams = self._native(entry)
        paths = [regular.inside(self.path, entry.file), *native_streams.values()]
        paths += [] if native_streams else [regular.inside(self.path, video) for video in entry.videos.values()]
        with regular.failing(self.path):
            files = {path.relative_to(self.path).as_posix(): path for path in paths if file_system.present(path)}
        values = {
            "fps": dataset.fps,
            "robot": dataset.robot,
            "features": dataset.info["features"],
            "index": entry.index,
        }
        values |= {"tasks": list(entry.tasks), "videos": dict(entry.videos), "attributes": dict(entry.attributes)}
        values |= {"length": entry.length}
        return Share(files or {description.INFO: self.path / description.INFO}, values)

    @functools.cached_property
    def _about(self) -> LeRobotDescription:
        return description.read_description(self.path)

    @functools.cached_property
    def _episodes(self) -> dict[str, EpisodeDescription]:
        episodes = self._about.episodes()
        container.parts_by_name(((str(episode.index), episode) for episode in episodes), self.path, INDEX)
        return container.parts_by_name(((episode.name, episode) for episode in episodes), self.path, "episode named")

    def _notes(self, episode: EpisodeDescription) -> list[str]:
        """Return, for the first episode only, a note if the dataset declares a different number of episodes."""
        declared_count = self._about.info.get("total_episodes")
        first = next(iter(self._episodes.values()))
        if not isinstance(declared_count, int) or declared_count == len(self._episodes) or episode is not first:
            return []
        return [
            f"{self.path} describes {len(self._episodes)} episodes, and {description.INFO} states {declared_count}."
        ]

    def _find_episode(self, name: str | None) -> EpisodeDescription:
        if name not in self._episodes:
            raise TacpipeError(f"{self.path} holds no episode {plain(str(name))}.")
        return self._episodes[name]

    def _native(self, episode: EpisodeDescription) -> dict[str, Path]:
        """Return the files of the original streams of an exported episode by stream; the key is "" for a single table."""
        folder, file = (regular.inside(self.path, f"{NATIVE}/{episode.name}{end}") for end in ("", ".parquet"))
        paths = {path.stem: path for path in file_system.listed(folder, "*.parquet")}
        return {"": file} if file.is_file() and not paths else paths

    def _contents(self, episode: EpisodeDescription, sources: Collection[str] | None, *, rows: bool) -> EpisodeContents:
        """Return the streams, attributes and missing videos of an episode; without ``rows``, only the first ones."""
        native_streams = self._native(episode)
        if native_streams:
            streams = [
                self._exported_stream(name, path)
                for name, path in native_streams.items()
                if _is_selected(name, sources)
            ]
            return EpisodeContents(streams, episode.original or {}, notes=self._notes(episode))
        attributes: dict[str, Attribute] = {**episode.attributes, "episode_index": episode.index}
        attributes |= episode.original or {}
        if episode.tasks:
            attributes["task"] = "; ".join(episode.tasks)
        if self._about.robot:
            attributes["robot_type"] = self._about.robot
        skipped = {
            key: f"is a video, {path}, which does not exist"
            for key, path in episode.videos.items()
            if not file_system.present(regular.inside(self.path, path))
        }
        attributes |= {f"video.{key}": path for key, path in episode.videos.items()}
        streams, time_notes = self._streams(episode, sources, rows=rows)
        notes = [*self._notes(episode), *time_notes]
        return EpisodeContents(streams, attributes | {"fps": self._about.fps}, skipped, notes)

    def _exported_stream(self, name: str, path: Path) -> SourceStream:
        """Return a stream bit for bit as before the export. Rows of a long stream are decoded when they are read."""
        with _advise_copy(path):
            stored = ParquetTable(regular.source(path))
            content = stored.read() if stored.num_rows <= SOME_ROWS else None

        def read() -> Iterator[pa.Table]:
            with _advise_copy(path):
                yield from stored.batches()

        rows = Batched(stored.schema, stored.num_rows, read) if content is None else content
        return SourceStream(name, name, Time(column="t_ns", unit="ns"), rows, stored.num_rows)

    def _streams(
        self, episode: EpisodeDescription, sources: Collection[str] | None, *, rows: bool
    ) -> tuple[list[SourceStream], list[str]]:
        """Return the streams of an episode: one per feature or group of features, and one per video. Adds notes on time.

        The tables are empty if ``rows`` is False.
        """
        by_source: dict[str, list[FeatureDescription]] = {}
        for feature in self._about.features.values():
            if feature.key not in (*COUNTING_FEATURES, EXACT) and feature.dtype != "video":
                prefix = feature.key.partition(".")[0]
                by_source.setdefault(prefix if prefix in SHARED_STREAMS else feature.key, []).append(feature)
        videos = [
            key
            for key, video in episode.videos.items()
            if _is_selected(key, sources) and file_system.present(regular.inside(self.path, video))
        ]
        names = container.identifiers([_stream_stem(source) for source in [*by_source, *episode.videos]])
        selected = {source: features for source, features in by_source.items() if _is_selected(source, sources)}
        exact_keys = [EXACT] if EXACT in self._about.features else []
        frames = self._frames(
            episode, [*exact_keys, *(feature.key for features in selected.values() for feature in features)]
        )
        if exact_keys:
            t_ns, time_metadata, notes = frames.column(EXACT).to_numpy(), {}, list[str]()
        else:
            t_ns, stamp_source = _frame_stamps(frames, self._about.fps, self.path / episode.file)
            time_metadata = {"made": stamp_source}
            notes = [self._describe_rate(t_ns)] if stamp_source == FROM_STAMPS else []
        clock = pa.field(CLOCK.column, pa.int64(), metadata=time_metadata)
        frames = frames if rows else frames.slice(0, 0)
        streams = [
            self._video_stream(episode, key, names[_stream_stem(key)], (t_ns, clock), notes if rows else None)
            for key in videos
        ]
        streams = [replace(stream, time=replace(CLOCK, origin="unix")) if exact_keys else stream for stream in streams]
        for source, features in selected.items():
            columns = [(clock, pa.array(t_ns[: frames.num_rows]))]
            for feature in features:
                columns += self._columns(episode, feature, frames.column(feature.key))
            table = pa.table([values for _, values in columns], pa.schema([field for field, _ in columns]))
            time = replace(CLOCK, origin="unix") if exact_keys else CLOCK
            streams.append(SourceStream(source, names[_stream_stem(source)], time, table, episode.length))
        return streams, notes

    def _describe_rate(self, t_ns: Int64s) -> str:
        """Return a sentence about timestamps (time,) that do not agree with the declared rate."""
        step_ns = float(np.median(np.diff(t_ns))) if len(t_ns) > 1 else 0.0
        rate = f" of about {1e9 / step_ns:.3g} Hz" if step_ns > 0 else ""
        return (
            f"{self.path}: {description.INFO} states {self._about.fps:g} fps, and {STAMP} has other times{rate}. t_ns has "
            f"those of {STAMP}. For times at a rate, write time = {{ rate_hz = … }} in a layout."
        )

    def _video_stream(
        self, episode: EpisodeDescription, key: str, name: str, clock: tuple[Int64s, pa.Field], notes: list[str] | None
    ) -> SourceStream:
        """Return a stream of an episode's frames in the video ``key``.

        ``clock`` are the timestamps (frame,) and their field. Damaged frames are marked and noted, unless ``notes`` is
        None. Raises `TacpipeError` if the video is unreadable, shorter than the episode, or cannot be cut at the
        episode's start and end.
        """
        path = regular.inside(self.path, episode.videos[key])
        frames = _scan_video(path, path.stat().st_mtime_ns)
        t_ns, clock_field = clock
        half_step_s = 0.5 / self._about.fps
        start_s = episode.video_starts_s.get(key, 0.0)
        start = int(np.searchsorted(frames.times_ns() / 1e9, start_s - half_step_s))
        stop = start + len(t_ns)
        if stop > len(frames):
            raise TacpipeError(
                f"{path} has {len(frames)} frames, and episode {episode.index} is its frames {start} to {stop}. Copy the "
                f"dataset again."
            )
        if cut_rows(frames.dts, frames.key_frame, start, stop) != (start, stop):
            raise TacpipeError(
                f"{path}: the frames {start} to {stop} of episode {episode.index} cannot be cut out at key frames. Write "
                f"the episode to a video of its own."
            )
        counter = frames.counter()
        seq = None if counter is None else counter[start:stop] - counter[start]
        clocks = (frames.pts[start:stop], frames.dts[start:stop], frames.key_frame[start:stop])

        def batches(damaged: Bools | None) -> pa.RecordBatchReader:
            packets = itertools.islice(read_packets(path, frames), start, stop)
            return packet_stream(frames.video_format, packets, clocks, t_ns, seq, None, damaged)

        suspect = frames.suspect[start:stop]
        damaged = None if notes is None else find_damage(batches(None), frames.video_format, suspect, path, notes)
        damaged = damaged if damaged is not None and damaged.any() else None
        schema = pa.schema([clock_field, *list(batches(damaged).schema)[1:]])

        def read() -> Iterator[pa.Table]:
            for batch in batches(damaged):
                yield pa.Table.from_batches([batch]).cast(schema)

        return SourceStream(key, name, CLOCK, Batched(schema, len(t_ns), read), episode.length)

    def _frames(self, episode: EpisodeDescription, keys: Sequence[str]) -> pa.Table:
        """Return the rows of an episode. Raises `TacpipeError` if its file is damaged or has other columns or rows."""
        path = regular.inside(self.path, episode.file)
        with description.parquet_errors(path), regular.opened(path) as source:
            file = pq.ParquetFile(source, page_checksum_verification=True)
            column_names = set(file.schema_arrow.names)
            missing = [key for key in (INDEX, FRAME, STAMP, *keys) if key not in column_names]
            if missing:
                raise TacpipeError(f"{path} has no column {plain(missing[0])}, which {description.INFO} names.")
            groups = _row_groups_of_episode(file, episode.index)
            share = sum(file.metadata.row_group(group).num_rows for group in groups) / max(file.metadata.num_rows, 1)
            parquet.require_claims(path, [INDEX, FRAME, STAMP, *keys], share=share)
            columns = [INDEX, FRAME, STAMP, *keys]
            frames = file.read_row_groups([], columns=columns, use_threads=False)
            for group in groups:  # filtering each row group bounds the memory
                rows = file.read_row_group(group, columns=columns, use_threads=False)
                if nulls := rows.column(INDEX).null_count:
                    raise TacpipeError(f"{path}: {INDEX} of {nulls} rows is null. {WRITE_AGAIN}")
                frames = pa.concat_tables([frames, rows.filter(pc.equal(rows.column(INDEX), episode.index))])
        if frames.num_rows != episode.length:
            raise TacpipeError(
                f"{path} holds {frames.num_rows} frames of episode {episode.index}, and the folder meta states "
                f"{episode.length}. Copy the dataset again."
            )
        return frames

    def _columns(
        self, episode: EpisodeDescription, feature: FeatureDescription, values: pa.ChunkedArray
    ) -> list[tuple[pa.Field, pa.Array | pa.ChunkedArray]]:
        """Return field and values of each column of a feature."""
        if feature.dtype == "image":
            return [(pa.field(PICTURE, pa.binary(), metadata={"quantity": "image"}), _picture_bytes(values))]
        short_name = feature.key.rpartition(".")[2]
        column_meanings = meanings(short_name, feature.width, feature.dtype.startswith(("int", "uint", "bool")))
        names = feature.names or (
            [short_name] if feature.width == 1 else [f"{short_name}_{position}" for position in range(feature.width)]
        )
        columns: list[tuple[pa.Field, pa.Array | pa.ChunkedArray]] = []
        for position, column in enumerate(self._flat(episode, feature, values)):
            meaning = (
                column_meanings[position]
                if column_meanings[position] != NO_MEANING
                else meaning_from_name(names[position], feature.dtype)
            )
            metadata = {"quantity": meaning.quantity, "unit": meaning.unit, "component": meaning.component}
            if feature.quantities:
                metadata = {
                    "quantity": feature.quantities[position],
                    "unit": feature.units[position] if feature.units else "",
                }
            columns.append(
                (pa.field(names[position], column.type, metadata={k: v for k, v in metadata.items() if v}), column)
            )
        return columns

    def _flat(
        self, episode: EpisodeDescription, feature: FeatureDescription, values: pa.ChunkedArray
    ) -> Sequence[pa.Array | pa.ChunkedArray]:
        """Return the columns of a feature; nested lists are flattened.

        Raises `TacpipeError` if a row does not have as many values as the feature declares.
        """
        inner = values.combine_chunks()
        while (
            pa.types.is_list(inner.type)
            or pa.types.is_fixed_size_list(inner.type)
            or pa.types.is_large_list(inner.type)
        ):
            inner = inner.flatten()
        is_text = pa.types.is_string(inner.type)
        if not pa.types.is_nested(values.type):
            if inner.null_count and not is_text:
                raise _values_error(self.path / episode.file, feature.key, values, 1)
            return [pa.array(inner)]
        if len(inner) != len(values) * feature.width or inner.null_count:
            raise _values_error(self.path / episode.file, feature.key, values, feature.width)
        if is_text:
            return [
                inner.take(pa.array(np.arange(position, len(inner), feature.width)))
                for position in range(feature.width)
            ]
        flat = inner.to_numpy(zero_copy_only=False).reshape(len(values), feature.width)
        return [pa.array(np.ascontiguousarray(flat[:, position])) for position in range(feature.width)]


@contextlib.contextmanager
def _advise_copy(path: Path) -> Iterator[None]:
    """Add the advice to copy the file again to errors in the block."""
    try:
        yield
    except TacpipeError as error:
        raise TacpipeError(f"{path} cannot be read: {error} Copy it again.") from error


def _is_selected(source: str, sources: Collection[str] | None) -> bool:
    return sources is None or source in sources


def _stream_stem(source: str) -> str:
    """Return the stream name for a feature, without LeRobot's common prefixes.

    >>> _stream_stem("observation.state"), _stream_stem("observation.tactile.xela1"), _stream_stem("action")
    ('state', 'xela1', 'action')
    """
    return source.removeprefix("observation.").removeprefix("tactile.").removeprefix("images.")


def _row_groups_of_episode(file: pq.ParquetFile, episode: int) -> list[int]:
    """Return the row groups that may contain an episode, according to the statistics of its index."""
    metadata = file.metadata
    column = [metadata.schema.column(number).path for number in range(metadata.num_columns)].index(INDEX)
    statistics_by_group = [
        metadata.row_group(group).column(column).statistics for group in range(metadata.num_row_groups)
    ]
    return [
        group
        for group, statistics in enumerate(statistics_by_group)
        if statistics is None or not statistics.has_min_max or statistics.min <= episode <= statistics.max
    ]


def _values_error(path: Path, key: str, values: pa.ChunkedArray, width: int) -> TacpipeError:
    """Return the error for the first frame (counted from 0) with a null or another number of values than ``width``."""
    for frame, entry in enumerate(values.to_pylist()):
        leaves = description.leaves(entry)
        if None in leaves:
            place = f", value {leaves.index(None)}," if isinstance(entry, list) else ""
            return TacpipeError(f"{path}: frame {frame}{place} of {plain(key)} is null (counted from 0). {WRITE_AGAIN}")
        if len(leaves) != width:
            break
    return TacpipeError(
        f"{path}: frame {frame} of {plain(key)} (counted from 0) has {len(leaves)} values, and {description.INFO} states "
        f"{width}. {WRITE_AGAIN}"
    )


def _frame_stamps(frames: pa.Table, fps: float, path: Path) -> tuple[Int64s, str]:
    """Return timestamps (time,) in ns since the start of the episode, and how they were made.

    They are computed from the rate if the stored times agree with it. Raises `TacpipeError` if a time is null or not
    finite.
    """
    for key in (FRAME, STAMP):
        if frames.column(key).null_count:
            raise _values_error(path, key, frames.column(key), 1)
    index = frames.column(FRAME).to_numpy().astype(np.int64)  # (time,)
    seconds = frames.column(STAMP).to_numpy().astype(np.float64)
    if not np.isfinite(seconds).all():
        row = int((~np.isfinite(seconds)).argmax())
        raise TacpipeError(
            f"{path}: {STAMP} of frame {row} (counted from 0) is {seconds[row]}; it must be a number of seconds."
        )
    allowed_s = TOLERANCE_S + np.spacing(np.abs(seconds).astype(np.float32))  # adds the rounding of float32
    if (np.abs(index / fps - seconds) <= allowed_s).all():
        return _exact_stamps(index, fps), FROM_RATE
    return np.rint(seconds * 1e9).astype(np.int64), FROM_STAMPS


def _exact_stamps(index: Int64s, fps: float) -> Int64s:
    """Return ``index / fps`` in ns (frame,), rounded, computed with integers from the exact ratio of ``fps``.

    >>> _exact_stamps(np.array([1, 2, 3]), 30.0).tolist()
    [33333333, 66666667, 100000000]
    """
    numerator, denominator = fps.as_integer_ratio()
    return np.array(
        [(2 * int(frame) * 10**9 * denominator + numerator) // (2 * numerator) for frame in index], np.int64
    )


def _picture_bytes(values: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return the bytes of images, which are stored together with a path."""
    return pc.struct_field(values, "bytes") if pa.types.is_struct(values.type) else values
