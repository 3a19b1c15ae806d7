"""A bag as a container of streams: the storages' records, decoded topic by topic in one pass over its files."""

from __future__ import annotations

import contextlib
import tempfile
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from tacpipe.errors import TacpipeError
from tacpipe.formats import unique_names
from tacpipe.formats.bags import bag_file, json_messages, mcap_file, own, protobuf_messages, ros, sqlite_file
from tacpipe.formats.bags.own import Own
from tacpipe.formats.bags.storages import Channel, Damage, Message, Metadata, Record
from tacpipe.formats.bags.topics import Decoder, Topic, TopicError
from tacpipe.formats.containers import kinds
from tacpipe.formats.containers.container import Contents, SourceStream
from tacpipe.io import files as file_system
from tacpipe.io import regular, yaml_text
from tacpipe.io.spill import Spill, unpack
from tacpipe.plugins import extras
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import excerpt, listed, plain

LOOK_MESSAGES = 20_000  # after which a look at a file ends
MOST_BYTES = 1 << 22  # of a metadata.yaml
READERS = {".mcap": mcap_file.records, ".db3": sqlite_file.records, ".bag": bag_file.records}
UNPACKED_BYTES = 1 << 20  # bytes decompressed at once
ZSTD = ".zstd"  # the ending of a file that was compressed as a whole
ACTIVE = ".active"  # of a ROS 1 bag that is being written, or whose recorder was killed
OF = ":"  # between a topic and what names one of its streams, as "/tf:gripper"
OWN = "rosbag2"  # the metadata record that a ROS 2 bag writes about itself


@dataclass(frozen=True)
class Bag:
    """A bag: one file, or a folder of ROS 2 with its ``metadata.yaml``."""

    path: Path

    def episodes(self) -> Sequence[str]:
        """Return nothing: a bag is one recording."""
        return ()

    def look(self, episode: str | None) -> Contents:
        """Return the streams of the first messages."""
        return self._read(None, LOOK_MESSAGES)

    def read(self, sources: Collection[str] | None, episode: str | None) -> Contents:
        """Return the streams of these topics, or of all."""
        return self._read(sources, None)

    def _read(self, sources: Collection[str] | None, most: int | None) -> Contents:
        with contextlib.ExitStack() as stack:
            files, messages_compressed, notes = _files(self.path, stack)
            reading = _Reading(self.path, sources, messages_compressed)
            for number, file in enumerate(files):
                reading.take(_records(file), number, most)
        contents = reading.contents()
        return Contents(contents.streams, contents.attributes, contents.skipped, [*notes, *contents.notes])


def opened(path: Path) -> Bag:
    """Return the bag at ``path``. Raises `MissingModuleError` where a library is missing."""
    extras.require("Reading bags and MCAP files", "rosbags", "mcap", "lz4", "zstandard", "google.protobuf")
    return Bag(path)


def _files(path: Path, stack: contextlib.ExitStack) -> tuple[list[Path], bool, list[str]]:
    """Return the files of a bag in their order, whether each message is compressed, and what is to be noted."""
    if not path.is_dir():
        return [_unpacked(path, stack)], False, []
    about = _described(path / "metadata.yaml")
    listing = about.get("relative_file_paths")
    names = [Path(str(name)).name for name in listing] if isinstance(listing, list) else []
    unique_names.by_name(((name, name) for name in names), path / "metadata.yaml", "file")
    missing = [name for name in names if not (path / name).is_file()]
    notes = [f"{path} lacks {listed(missing, 3)}, which its metadata.yaml names."] if missing else []
    bag_files = sorted(file for file in file_system.listed(path) if _ending(file) in READERS)
    present_files = [regular.inside(path, name) for name in names if name not in missing] or bag_files  # renamed since
    if unlisted := [file.name for file in bag_files if file not in present_files]:
        notes.append(
            f"{path} holds {listed(unlisted, 3)}, which its metadata.yaml does not name and which are not read."
        )
    if not present_files:
        raise TacpipeError(f"{path} holds no file of a bag; its metadata.yaml names {listed(names, 3) or 'none'}.")
    if unknown := [one.name for one in present_files if _ending(one) not in READERS]:
        storage = excerpt(about.get("storage_identifier"))
        raise TacpipeError(f"{path}: {plain(unknown[0])} is of the storage {storage}; mcap and sqlite3 are read.")
    compressed = str(about.get("compression_mode") or "").lower() == "message"
    return [_unpacked(one, stack) for one in present_files], compressed, notes


def _records(path: Path) -> Iterator[Record]:
    if _ending(path) not in READERS:
        raise TacpipeError(f"{path} is not a bag by its name; {', '.join(READERS)} are read.")
    return _streamed(path) if path.suffix.lower() == ZSTD else READERS[_ending(path)](path)


def _streamed(path: Path) -> Iterator[Record]:
    """Yield the records of an MCAP file that is compressed as a whole."""
    import zstandard

    with (
        regular.failing(path),
        regular.opened(path) as file,
        zstandard.ZstdDecompressor().stream_reader(file) as content,
    ):
        try:
            yield from mcap_file.stream_records(path, content)
        except zstandard.ZstdError as error:
            yield Damage(f"{path} cannot be unpacked ({plain(str(error), 80)}): what came after is missing.")


def _ending(path: Path) -> str:
    """Return the ending of a file, that below .zstd where it is compressed as a whole, or .active where it was cut off."""
    return (path.with_suffix("") if path.suffix.lower() in (ZSTD, ACTIVE) else path).suffix.lower()


def _described(path: Path) -> dict[str, Any]:
    try:
        value = yaml_text.load(regular.content(regular.inside(path.parent, path.name), MOST_BYTES).decode())
        about = value["rosbag2_bagfile_information"]
        return dict(about)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise TacpipeError(
            f"{path} does not describe a bag: {plain(str(error), 120)}. Without it the files next to it are read one by one."
        ) from error


def _unpacked(path: Path, stack: contextlib.ExitStack) -> Path:
    """Return a file, a database unpacked into a temporary folder where it is compressed as a whole."""
    if path.suffix.lower() != ZSTD or _ending(path) == ".mcap":
        return path
    import zstandard

    folder = stack.enter_context(tempfile.TemporaryDirectory())
    made = Path(folder, path.stem)
    with regular.failing(path), regular.opened(path) as file, made.open("wb") as out:
        try:
            with zstandard.ZstdDecompressor().stream_reader(file) as content:
                unpack(iter(lambda: content.read(UNPACKED_BYTES), b""), out, path)
        except zstandard.ZstdError as error:
            raise TacpipeError(f"{path} cannot be unpacked: {plain(str(error), 80)}.") from error
    return made


@dataclass
class _Reading:
    """What is known of a bag while its records pass."""

    path: Path
    sources: Collection[str] | None
    compressed: bool
    ended_early: bool = False
    topics: dict[str, Topic] = field(default_factory=dict)
    types: dict[str, str] = field(default_factory=dict)  # of each topic
    skipped: dict[str, str] = field(default_factory=dict)
    attributes: dict[str, Attribute] = field(default_factory=dict)
    own: dict[str, Own] = field(default_factory=dict)  # topics that tacpipe itself exported
    notes: list[str] = field(default_factory=list)
    aside: Spill = field(default_factory=Spill)  # decoded messages
    undescribed: int = 0  # messages of channels that no record describes
    _described: dict[tuple[int, int], Channel] = field(default_factory=dict)  # file and number to channel
    _channels: dict[tuple[int, int], str] = field(default_factory=dict)  # file and number to topic

    def take(self, records: Iterator[Record], file: int, most: int | None) -> None:
        """Take in the records of one file of the bag, ``most`` messages of it at most."""
        for record in records:
            if isinstance(record, Message):
                self._message(record, file)
                if most is not None and (most := most - 1) <= 0:
                    self.ended_early = True
                    return
            elif isinstance(record, Channel):
                self._channel(record, file)
            elif isinstance(record, Metadata):
                self._metadata(record)
            elif isinstance(record, Damage):
                self.notes.append(record.text)

    def _channel(self, channel: Channel, file: int) -> None:
        topic = channel.topic
        before = self._described.setdefault((file, channel.number), channel)
        if before is not channel:  # chunks repeat the channels of their messages
            if before != channel:
                raise TacpipeError(
                    f"{self.path} describes the channel {channel.number} twice, as {plain(before.topic)} and as "
                    f"{plain(topic)}, so its messages cannot be assigned. Record it again, or repair it with `mcap recover`."
                )
            return
        if (found := own.described(channel.metadata)) is not None:
            if found.derived:
                return
            self.own[topic] = found
        if self.sources is not None and all(one.split(OF)[0] != topic for one in self.sources):
            return
        self._channels[file, channel.number] = topic
        if topic in self.skipped:
            return
        if topic in self.topics:
            if self.types[topic] != channel.type:
                self._skip(topic, f"it has messages of two types, {plain(self.types[topic])} and {plain(channel.type)}")
            return
        try:
            self.topics[topic] = Topic(_decoder(channel), self.aside)
            self.types[topic] = channel.type
        except TopicError as error:
            self._skip(topic, str(error))

    def _message(self, message: Message, file: int) -> None:
        topic = self.topics.get(self._channels.get((file, message.channel), ""))
        if topic is None:
            self.undescribed += (file, message.channel) not in self._described
            return
        try:
            content = _unzipped(message.content) if self.compressed else message.content
            topic.add(content, message.log_ns, message.publish_ns)
        except TopicError as error:
            self._skip(self._channels[file, message.channel], str(error))

    def _metadata(self, found: Metadata) -> None:
        if found.name == OWN:
            if found.values.get("ros_distro"):
                self.attributes["ros_distro"] = found.values["ros_distro"]
            return
        if found.name == own.KEY:
            self.attributes |= own.attributes(found.values)
            return
        from tacpipe.formats.table.label_texts import plain_value

        for name, value in found.values.items():
            self.attributes.setdefault(plain(name), plain_value(value))

    def _skip(self, topic: str, why: str) -> None:
        self.skipped[topic] = why
        self.topics.pop(topic, None)

    def contents(self) -> Contents:
        """Return what was read."""
        found: list[tuple[Own | None, SourceStream]] = []
        for topic, reading in list(self.topics.items()):
            if not reading.count:
                continue
            try:
                finished = reading.finish()
            except TopicError as error:
                self._skip(topic, str(error))
                continue
            if not finished:
                self.skipped[topic] = f"its messages ({plain(self.types[topic])}) hold no values"
            for one in finished:
                source = f"{topic}{OF}{one.suffix}" if one.suffix else topic
                if self.sources is not None and source not in self.sources:
                    continue
                rows = None if self.ended_early else one.content.rows
                before = self.own.get(topic)
                name = before.stream if before is not None and before.stream else source
                found.append((before, SourceStream(source, name, one.time, one.content, rows)))
                if one.note:
                    self.notes.append(f"{plain(source)}: {one.note}; its log times are used.")
        if self.undescribed:
            self.notes.append(f"{self.path} has {self.undescribed:,} messages of channels that it does not describe.")
        if self.ended_early:
            self.notes.append(
                f"The first {LOOK_MESSAGES} messages of each file were looked at; later ones may have other topics."
            )
        if not found and not self.skipped:
            self.skipped = dict.fromkeys(self.topics, "it has no messages")
        streams = [stream if before is None else own.restored(stream, before) for before, stream in found]
        known = Counter(stream.name for stream in streams)
        streams = [stream if known[stream.name] == 1 else replace(stream, name=stream.source) for stream in streams]
        names = kinds.identifiers([stream.name for stream in streams])
        streams = [replace(stream, name=names[stream.name]) for stream in streams]
        return Contents(streams, self.attributes, self.skipped, self.notes)


def _unzipped(content: bytes) -> bytes:
    import zstandard

    try:
        return zstandard.ZstdDecompressor().decompressobj().decompress(content)
    except zstandard.ZstdError as error:
        raise TopicError("a compressed message is damaged") from error


def _decoder(channel: Channel) -> Decoder:
    """Return what decodes the messages of a channel. Raises `TopicError` where none does."""
    text = channel.schema.decode(errors="replace")
    if channel.encoding in ("ros1", "cdr"):
        kind: ros.Definition = "idl" if channel.schema_encoding == "ros2idl" else "msg"
        name = ros.normal(channel.type)
        return ros.Ros(name, ros.types(name, kind, text), channel.encoding == "cdr")
    if channel.encoding == "json":
        return json_messages.Json(text)
    if channel.encoding == "protobuf":
        return protobuf_messages.Protobuf(channel.type, channel.schema)
    raise TopicError(
        f"its messages are written as {plain(channel.encoding) or 'nothing known'}, not ros1, cdr, json or protobuf"
    )
