"""The same questions to every reader: two parts with one name, a damaged block, a declared size, a way out, a codec.

A reader answers with all recordings, with a note that names the loss, or with an error; nothing is lost without a word.
"""

import json
import pickle
import re
import shlex
import sqlite3
import struct
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import openpyxl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import zstandard
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from tacpipe.engine import computing
from tacpipe.errors import ShortageError
from tacpipe.formats.table import recordings
from tacpipe.plugins import failures, registry
from tests import peaks
from tests.conftest import Lab, Ran
from tests.formats import grasp_files, slide_files, video_files, xdf_writer, xela_files
from tests.formats.arrays import files as array_files
from tests.formats.bags import writers
from tests.formats.lerobot import files as lerobot_files
from tests.promises.counts import count
from tests.promises.limits import is_sentence
from tests.video import videos
from tests.video.test_damage import damage

LAYOUT = '[streams.a]\nfiles = "{trial}.%s"\ntime = { column = "t" }\ncolumns = [{ match = "a*", unit = "N" }]\n'
RATE = '[streams.data]\nsource = "data"\ntime = { rate_hz = 60 }\n'


@dataclass(frozen=True)
class Case:
    """A source that a function writes into an empty folder, and what ingest answers."""

    write: Callable[[Path], object]
    answer: str | int  # a pattern of the error or the note; or the number of recordings that are all read
    layout: str = ""
    option: str = ""


def ask(lab: Lab, reader: str, case: Case, question: str) -> None:
    """Ingest the source of a case and compare the answer."""
    source = lab.folder / "source"
    source.mkdir()
    case.write(source)
    command = f"ingest {reader} {source} -o out {case.option}"
    if case.layout:
        (lab.folder / "layout.toml").write_text(case.layout)
        command += " --layout layout.toml"
    ran = lab.call(command)
    assert "Traceback" not in ran.err
    if isinstance(case.answer, int):
        assert ran.code == 0, ran.err
        assert len(lab.manifest("out").recordings) == case.answer
    else:
        assert re.search(case.answer, ran.err), ran.err
        assert all(is_sentence(line) for line in ran.err.splitlines() if len(line) > 60), ran.err
    count(f"{reader}: {question}")


def every_case(cases: dict[str, list[Case] | str]) -> list[Any]:
    """Return the cases of all readers as params; a reader without one has a text that states why."""
    return [
        pytest.param(reader, case, id=f"{reader}-{number}")
        for reader, reader_cases in cases.items()
        if not isinstance(reader_cases, str)
        for number, case in enumerate(reader_cases)
    ]


# ---- Two parts with one name


def _episodes_with(value: dict[str, Any]) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        lerobot_files.write_v2(folder / "set")
        path = folder / "set" / "meta" / "episodes.jsonl"
        lines = [json.loads(line) | value for line in path.read_text().splitlines()]
        path.write_text("".join(json.dumps(line) + "\n" for line in lines))

    return write


def _features_twice(folder: Path) -> None:
    lerobot_files.write_v2(folder / "set")
    path = folder / "set" / "meta" / "info.json"
    path.write_text(
        path.read_text().replace('"action":', '"observation.state": {"dtype": "a", "shape": [1]}, "action":')
    )


def _channel_twice(folder: Path) -> None:
    writers.mcap_json(folder / "a.mcap", {"/a": [(1, {"v": 1})], "/b": [(2, {"v": 2})]}, use_chunking=False)
    content = (folder / "a.mcap").read_bytes()
    channel = struct.pack("<HH", 2, 2) + struct.pack("<I", 2) + b"/b"
    assert content.count(channel) == 2  # It stands before the messages, and in the summary.
    renumbered = struct.pack("<HH", 1, 2) + struct.pack("<I", 2) + b"/b"
    (folder / "a.mcap").write_bytes(content.replace(channel, renumbered))


def _undescribed(folder: Path) -> None:
    writers.mcap_json(folder / "a.mcap", {"/a": [(n, {"v": 1}) for n in range(3)]}, use_chunking=False)
    content = (folder / "a.mcap").read_bytes()
    message = struct.pack("<HIQQ", 1, 0, 1, 1)
    assert content.count(message) == 1
    (folder / "a.mcap").write_bytes(content.replace(message, struct.pack("<HIQQ", 9, 0, 1, 1)))


def _entry_twice(folder: Path) -> None:
    path = folder / "a.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        channel = writer.register_channel("/a", "json", 0)
        writer.add_message(channel, 1, b'{"v": 1, "v": 2}', 1)
        writer.finish()  # type: ignore[no-untyped-call]


def _connection_twice(folder: Path) -> None:
    path = _bag(folder)
    content = path.read_bytes()
    number = b"conn=" + struct.pack("<I", 1)
    assert number in content
    path.write_bytes(content.replace(number, b"conn=" + struct.pack("<I", 0)))


def _bag(folder: Path, compression: str | None = None) -> Path:
    types = writers.store(ros1=True)
    sent = [
        (
            topic,
            "std_msgs/msg/Float64",
            writers.START_NS + step,
            writers.build(types, "std_msgs/msg/Float64", data=step),
        )
        for step in range(200)
        for topic in ("/a", "/b")
    ]
    return writers.ros1(folder / "a.bag", sent, compression)


def _topic_twice(folder: Path) -> None:
    types = writers.store()
    message = writers.build(types, "std_msgs/msg/Float64", data=1.5)
    writers.ros2(folder / "a", [(topic, "std_msgs/msg/Float64", 1, message) for topic in ("/a", "/b")], "sqlite3")
    with closing(sqlite3.connect(folder / "a" / "a.db3")) as connection, connection:
        connection.execute("CREATE TABLE other AS SELECT * FROM topics")
        connection.execute("DROP TABLE topics")
        connection.execute("ALTER TABLE other RENAME TO topics")
        connection.execute("UPDATE topics SET id = 1")


def _file_twice(folder: Path) -> None:
    types = writers.store()
    message = writers.build(types, "std_msgs/msg/Float64", data=1.5)
    writers.ros2(folder / "a", [("/a", "std_msgs/msg/Float64", 1, message)], "sqlite3")
    about = folder / "a" / "metadata.yaml"
    about.write_text(about.read_text().replace("- a.db3\n", "- a.db3\n  - other/a.db3\n"))


def _stream_twice(folder: Path) -> None:
    session = xdf_writer.Writer()
    for name in ("force", "other"):
        session.stream(1, name, "int16", 1)
        session.numbers(1, "int16", [0.1, 0.2], [[1], [2]])
    session.write(folder / "a.xdf")


def _groups_twice(folder: Path) -> None:
    with h5py.File(folder / "a.hdf5", "w") as file:
        for group in ("train/demo_0", "train/demo_1", "test/demo_0"):
            file[f"{group}/a"] = np.arange(5.0)
            file[f"{group}/t_s"] = np.arange(5.0)


def _episode_names_twice(folder: Path) -> None:
    array_files.replay(folder / "a.zarr")
    (folder / "a.zarr" / "meta" / ".zattrs").write_text(json.dumps({"recordings": ["a", "a", "b"]}))


def _archive(**arrays: Any) -> Callable[[Path], None]:
    return lambda folder: np.savez(folder / "a.npz", **arrays)


def _parquet_twice(folder: Path) -> None:
    table = pa.Table.from_arrays([pa.array([0.0, 1.0])] * 3, names=["t", "a", "a"])
    pq.write_table(table, folder / "a.parquet")


def _write_twice(write: Callable[[Path], object]) -> Callable[[Path], None]:
    """Return a function that writes the same trial into two folders."""

    def write_two_folders(folder: Path) -> None:
        for place in ("one", "two"):
            write(folder / place)

    return write_two_folders


def _nest(folder: Path) -> None:
    xela_files.write_flat(folder / "trial")
    xela_files.write_flat(folder / "trial" / "copy")


T = np.arange(3.0)
NAMED_TWICE: dict[str, list[Case] | str] = {
    "lerobot": [
        Case(_episodes_with({"tacpipe/recording": "cup"}), "more than one episode named cup"),
        Case(_episodes_with({"episode_index": 0}), "more than one episode_index 0"),
        Case(_features_twice, "more than one entry observation.state"),
    ],
    "mcap": [
        Case(_channel_twice, "describes the channel 1 twice, as /a and as /b"),
        Case(_undescribed, "1 messages of channels that it does not describe"),
        Case(_entry_twice, "two entries of the same name"),
    ],
    "rosbag": [
        Case(_connection_twice, "describes the channel 0 twice, as /a and as /b"),
        Case(_topic_twice, "describes the channel 1 twice"),
        Case(_file_twice, "more than one file a.db3"),
    ],
    "xdf": [Case(_stream_twice, "describes the stream 1 twice")],
    "hdf5": [Case(_groups_twice, 3)],
    "zarr": [Case(_episode_names_twice, 3, RATE)],
    "table": [
        Case(lambda folder: (folder / "x.csv").write_text("t,a,a\n0,1,2\n"), "more than one column a", LAYOUT % "csv"),
        Case(_archive(t=T, a=np.ones((3, 2)), a_1=T), "more than one column a_1", LAYOUT % "npz"),
        Case(_parquet_twice, "a", LAYOUT % "parquet"),
        Case(
            lambda folder: (folder / "x.jsonl").write_text('{"t": 0, "a": [1, 2], "a_1": 5}\n'),
            "more than one column a_1",
            LAYOUT % "jsonl",
        ),
    ],
    "biotac-slide": [Case(_write_twice(slide_files.write_biotac), "are the same slide")],
    "roboskin": [
        Case(
            _write_twice(lambda place: slide_files.write_roboskin(place, slide_files.touched(1, 20))),
            "are the same block",
        )
    ],
    "gelsight-slip": [Case(_write_twice(video_files.write_gelsight), "would both be named lemon-1")],
    "vision2tactile": [Case(_write_twice(grasp_files.write_grasp), "would both be named bleach")],
    "xela-flat": [Case(_write_twice(lambda place: xela_files.write_flat(place / "trial")), 2), Case(_nest, 2)],
    "xela-psc": [Case(_write_twice(lambda place: xela_files.write_psc(place / "trial")), 2)],
}


@pytest.mark.parametrize(("reader", "case"), every_case(NAMED_TWICE))
def test_of_two_parts_with_one_name_none_is_lost_without_a_word(lab: Lab, reader: str, case: Case) -> None:
    ask(lab, reader, case, "two parts with one name")


# ---- A damaged block


def _without_check_sums(content: bytes) -> bytes:
    """Return an MCAP file whose chunks have no check sums."""
    changed, at = bytearray(content), 8
    while at + 9 < len(changed):
        kind, length = struct.unpack_from("<BQ", changed, at)
        if kind == 6:
            changed[at + 9 + 24 : at + 9 + 28] = bytes(4)
        at += 9 + length
    return bytes(changed)


def _chunk_damaged(
    compression: CompressionType, change: Callable[[bytearray, int, int], None]
) -> Callable[[Path], None]:
    """Return a function that writes 4,000 messages and changes the third chunk: where it begins, and its length."""

    def write(folder: Path) -> None:
        sent = {"/a": [(writers.START_NS + n, {"v": n}) for n in range(4000)]}
        path = writers.mcap_json(folder / "a.mcap", sent, chunk_size=20_000, compression=compression)
        content = bytearray(_without_check_sums(path.read_bytes()))
        at, chunks_passed = 8, 0
        while True:
            kind, length = struct.unpack_from("<BQ", content, at)
            chunks_passed += kind == 6
            if chunks_passed == 3:
                break
            at += 9 + length
        change(content, at + 9, length)
        path.write_bytes(content)

    return write


def _flip(content: bytearray, at: int, length: int) -> None:
    content[at + length // 2 : at + length // 2 + 40] = bytes(40)


def _declare_less(content: bytearray, at: int, length: int) -> None:
    content[at + 16 : at + 24] = struct.pack("<Q", 100)


def _overlong_record(content: bytearray, at: int, length: int) -> None:
    end, at = at + length, at + 40  # The records begin after the header of a chunk that is not compressed.
    while at < end - 200:
        at += 9 + int(struct.unpack_from("<Q", content, at + 1)[0])
    content[at + 1 : at + 9] = struct.pack("<Q", 1 << 40)


LOST = r"a chunk .*; its \d+ messages from 2023-11-14T\S+ to 2023-11-14T\S+ are left out"


def _bag_damaged(compression: str | None) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        path = _bag(folder, compression)
        content = bytearray(path.read_bytes())
        at = content.index(b"op=\x05")
        content[at + 200 : at + 240] = b"\xff" * 40
        path.write_bytes(content)

    return write


def _changed_text(name: str, old: bytes, new: bytes) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        path = _bag(folder, "LZ4")
        content = path.read_bytes()
        assert path.name == name
        assert old in content
        path.write_bytes(content.replace(old, new))

    return write


def _database_damaged(folder: Path) -> None:
    types = writers.store()
    message = writers.build(types, "std_msgs/msg/Float64", data=1.5)
    writers.ros2(folder / "a", [("/a", "std_msgs/msg/Float64", n, message) for n in range(2000)], "sqlite3")
    content = bytearray((folder / "a" / "a.db3").read_bytes())
    content[len(content) // 2 : len(content) // 2 + 20000] = b"\xa5" * 20000
    (folder / "a" / "a.db3").write_bytes(content)


def _change(write: Callable[[Path], object], name: str, share: float = 0.5, width: int = 40) -> Callable[[Path], None]:
    """Return a function that writes a source and puts other bytes into the middle of one of its files."""

    def changed(folder: Path) -> None:
        write(folder)
        path = next(path for path in sorted(folder.rglob(name)) if path.is_file())
        content = bytearray(path.read_bytes())
        at = int(len(content) * share)
        content[at : at + width] = b"\xa5" * width
        path.write_bytes(content)

    return changed


def _session(folder: Path) -> None:
    session = xdf_writer.Writer()
    session.stream(1, "force", "int16", 1)
    for start in range(20):
        session.numbers(1, "int16", [start + 0.1, start + 0.2], [[1], [2]])
        session.boundary()
    session.footer(1, 40)
    session.write(folder / "a.xdf")


def _compress(folder: Path) -> None:
    with h5py.File(folder / "a.hdf5", "w") as file:
        values = np.random.default_rng(0).normal(size=4000)
        file.create_dataset("t", data=np.arange(4000.0))
        file.create_dataset("a", data=values, compression="gzip", chunks=(4000,))


def _table(kind: str) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        t, a = np.arange(3000.0), np.random.default_rng(0).normal(size=3000)
        if kind == "npz":
            np.savez_compressed(folder / "x.npz", t=t, a=a)
        elif kind == "parquet":
            pq.write_table(
                pa.table({"t": t, "a": a}), folder / "x.parquet", use_dictionary=False, write_page_checksum=True
            )
        else:
            rows = "".join(f"{x},{y}\n" for x, y in zip(t, a, strict=True))
            (folder / "x.csv").write_text(f"t,a\n{rows}")

    return write


DAMAGED: dict[str, list[Case] | str] = {
    "lerobot": [
        Case(
            _change(lambda folder: lerobot_files.write_v2(folder / "set"), "episode_000001.parquet"), "episode_000001"
        ),
        Case(_episodes_with({"length": 5}), "holds 12 frames of episode 0, and the folder meta states 5"),
    ],
    "mcap": [
        Case(_chunk_damaged(CompressionType.ZSTD, _flip), LOST),
        Case(_chunk_damaged(CompressionType.LZ4, _flip), LOST),
        Case(_chunk_damaged(CompressionType.ZSTD, _declare_less), LOST),
        Case(_chunk_damaged(CompressionType.NONE, _overlong_record), LOST),
    ],
    "rosbag": [
        Case(_bag_damaged("BZ2"), r"a chunk .*; its 400 messages from 2023-11-14T\S+ to 2023-11-14T\S+ are left out"),
        Case(_bag_damaged("LZ4"), r"its 400 messages from 2023"),
        Case(_bag_damaged(None), r"its 400 messages from 2023"),
        Case(_database_damaged, "is damaged .*what came after is missing"),
    ],
    "xdf": [Case(_change(_session, "a.xdf"), r"bytes .* are not XDF and were left out")],
    "hdf5": [Case(_change(_compress, "a.hdf5", 0.9), "cannot be read")],
    "zarr": [
        Case(
            _change(lambda folder: array_files.replay(folder / "a.zarr"), "data/robot0_eef_pos/1.0", 0.0),
            "cannot be read",
            RATE,
        )
    ],
    "table": [
        Case(_change(_table("csv"), "x.csv"), r"x\.csv", LAYOUT % "csv"),
        Case(_change(_table("npz"), "x.npz"), "is not an archive of arrays", LAYOUT % "npz"),
        Case(_change(_table("parquet"), "x.parquet"), r"x\.parquet", LAYOUT % "parquet"),
    ],
    "biotac-slide": [Case(_change(slide_files.write_biotac, "*_bio.csv"), "_bio.csv")],
    "roboskin": [
        Case(
            _change(lambda place: slide_files.write_roboskin(place, slide_files.touched(1, 20)), "labels_*.npy", 0.95),
            "labels_fold_0.npy",
        )
    ],
    "gelsight-slip": [
        Case(
            lambda folder: damage(video_files.write_gelsight(folder) / "camera_0.avi", 5),
            r"camera_0\.avi: 8 of 13 frames are damaged \(4 to 11\)",
        )
    ],
    "vision2tactile": [Case(_change(grasp_files.write_grasp, "tactile.tac"), "tactile.tac")],
    "xela-flat": [
        Case(_change(lambda place: xela_files.write_flat(place / "trial"), "xela_sensor1.csv"), "xela_sensor1.csv")
    ],
    "xela-psc": [
        Case(_change(lambda place: xela_files.write_psc(place / "trial"), "xela_sensor1.csv"), "xela_sensor1.csv")
    ],
}


@pytest.mark.parametrize(("reader", "case"), every_case(DAMAGED))
def test_of_a_damaged_block_the_loss_is_stated(lab: Lab, reader: str, case: Case) -> None:
    ask(lab, reader, case, "a damaged block")


# ---- A path that leads out of the source


def _link(write: Callable[[Path], object], name: str) -> Callable[[Path], None]:
    """Return a function that writes a source and puts a link to a copy elsewhere into the place of a file."""

    def linked(folder: Path) -> None:
        write(folder)
        path = next(path for path in sorted(folder.rglob(name)) if path.is_file())
        outside = folder.parent / "private"
        outside.mkdir()
        path.rename(outside / path.name)
        path.symlink_to(outside / path.name)

    return linked


def _path_above(folder: Path) -> None:
    lerobot_files.write_v2(folder / "set")
    path = folder / "set" / "meta" / "info.json"
    about = json.loads(path.read_text()) | {"data_path": "../../private/episode_{episode_index:06d}.parquet"}
    path.write_text(json.dumps(about))
    (folder.parent / "private").mkdir()
    for path in (folder / "set" / "data").rglob("*.parquet"):
        path.rename(folder.parent / "private" / path.name)


def _name_above(folder: Path) -> None:
    _episodes_with({"tacpipe/recording": "../../../private/other"})(folder)
    path = folder / "set" / "meta" / "episodes.jsonl"
    path.write_text(path.read_text().splitlines()[0])
    (folder.parent / "private").mkdir()
    pq.write_table(pa.table({"t_ns": [1, 2], "secret": [3, 4]}), folder.parent / "private" / "other.parquet")


def _external_link(folder: Path) -> None:
    outside = folder.parent / "private.hdf5"
    with h5py.File(outside, "w") as file:
        file["secret"] = np.arange(5.0)
    with h5py.File(folder / "a.hdf5", "w") as file:
        file["demo_0/t_s"] = file["demo_0/a"] = np.arange(5.0)
        file["demo_0/other"] = h5py.ExternalLink(outside, "secret")


def _log_elsewhere(folder: Path) -> None:
    _database_damaged(folder)
    (folder.parent / "private").write_bytes(b"secret")
    (folder / "a" / "a.db3-wal").symlink_to(folder.parent / "private")


OUT = "leads out of"
LEADS_OUT: dict[str, list[Case] | str] = {
    "lerobot": [
        Case(_path_above, OUT),
        Case(_name_above, OUT),
        Case(_link(lambda folder: lerobot_files.write_v2(folder / "set"), "info.json"), OUT),
        Case(_link(lambda folder: lerobot_files.write_v2(folder / "set"), "episode_000001.parquet"), OUT),
    ],
    "mcap": [Case(_link(lambda folder: writers.mcap_json(folder / "a.mcap", {"/a": [(1, {"v": 1})]}), "a.mcap"), OUT)],
    "rosbag": [
        Case(_link(_database_damaged, "a.db3"), OUT),
        Case(_link(_database_damaged, "metadata.yaml"), OUT),
        Case(_log_elsewhere, OUT),
    ],
    "xdf": [Case(_link(_session, "a.xdf"), OUT)],
    "hdf5": [Case(_link(_compress, "a.hdf5"), OUT), Case(_external_link, "lies in another file")],
    "zarr": [
        Case(_link(lambda folder: array_files.replay(folder / "a.zarr"), "1.0"), OUT, RATE),
        Case(_link(lambda folder: array_files.replay(folder / "a.zarr"), ".zarray"), OUT, RATE),
    ],
    "table": [Case(_link(_table("csv"), "x.csv"), OUT, LAYOUT % "csv")],
    "biotac-slide": [Case(_link(slide_files.write_biotac, "*_bio.csv"), OUT)],
    "roboskin": [
        Case(_link(lambda place: slide_files.write_roboskin(place, slide_files.touched(1, 20)), "labels*"), OUT)
    ],
    "gelsight-slip": [Case(_link(video_files.write_gelsight, "camera_2.avi"), OUT)],
    "vision2tactile": [Case(_link(grasp_files.write_grasp, "tactile.tac"), OUT)],
    "xela-flat": [Case(_link(lambda place: xela_files.write_flat(place / "trial"), "xela_sensor1.csv"), OUT)],
    "xela-psc": [Case(_link(lambda place: xela_files.write_psc(place / "trial"), "xela_sensor1.csv"), OUT)],
}


@pytest.mark.parametrize(("reader", "case"), every_case(LEADS_OUT))
def test_nothing_outside_the_source_is_read(lab: Lab, reader: str, case: Case) -> None:
    ask(lab, reader, case, "a path that leads out")


def test_links_are_followed_where_their_user_allows_it(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TACPIPE_FOLLOW_LINKS", "1")
    write = _link(lambda folder: array_files.replay(folder / "a.zarr"), "1.0")
    ask(lab, "zarr", Case(write, 3, RATE), "a path that leads out")


# ---- A codec


class Runs:
    """Object that creates a file if its pickle is opened."""

    def __reduce__(self) -> Any:
        return Path.touch, (Path("ran"),)


def _zarr_array(about: dict[str, Any], chunk: bytes, zarr_format: int = 2) -> Callable[[Path], None]:
    """Return a function that writes an array of 5 rows with these metadata beside a sound one."""

    def write(folder: Path) -> None:
        array_files.replay(folder / "a.zarr", zarr_format=zarr_format)
        place = folder / "a.zarr" / "data" / "evil"
        place.mkdir()
        (place / (".zarray" if zarr_format == 2 else "zarr.json")).write_text(json.dumps(about))
        (place / "0").write_bytes(chunk)

    return write


V2 = {"zarr_format": 2, "shape": [80], "chunks": [80], "order": "C", "fill_value": None, "compressor": None}
V3 = {
    **{"zarr_format": 3, "node_type": "array", "shape": [80], "data_type": "float64", "fill_value": 0.0},
    "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [80]}},
    "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
}
SHARDS = {"chunk_shape": [80], "codecs": [{"name": "numcodecs.pickle"}], "index_codecs": [{"name": "bytes"}]}


def _filter(folder: Path) -> None:
    with h5py.File(folder / "a.hdf5", "w") as file:
        file["demo_0/t_s"] = np.arange(5.0)
        file.create_dataset("demo_0/a", data=np.arange(5.0), chunks=(5,), shuffle=True)
    content = (folder / "a.hdf5").read_bytes()
    # number, length of the name, flags, values
    filter_description = struct.pack("<HH", 2, 8) + struct.pack("<HH", 1, 1) + b"shuffle\0"
    assert content.count(filter_description) == 1
    (folder / "a.hdf5").write_bytes(
        content.replace(filter_description, struct.pack("<H", 31999) + filter_description[2:])
    )


def _mcap_compressed(folder: Path) -> None:
    writers.mcap_json(folder / "a.mcap", {"/a": [(1, {"v": 1})]}, compression=CompressionType.LZ4)
    content = (folder / "a.mcap").read_bytes()
    (folder / "a.mcap").write_bytes(content.replace(struct.pack("<I", 3) + b"lz4", struct.pack("<I", 3) + b"pkl"))


def _pickled(write: Callable[[Path], object], name: str) -> Callable[[Path], None]:
    """Return a function that writes a source and puts a pickle that runs code into the place of a file."""

    def pickled(folder: Path) -> None:
        write(folder)
        path = next(path for path in sorted(folder.rglob(name)) if path.is_file())
        path.write_bytes(pickle.dumps(Runs()))

    return pickled


RUNS_CODE: dict[str, list[Case] | str] = {
    "lerobot": [
        Case(
            _pickled(lambda folder: lerobot_files.write_v2(folder / "set"), "episode_000001.parquet"),
            "episode_000001.parquet is not a whole Parquet file",
        )
    ],
    "mcap": [Case(_mcap_compressed, "compressed with pkl, not zstd or lz4")],
    "rosbag": [
        Case(_changed_text("a.bag", b"compression=lz4", b"compression=pkl"), "compressed with pkl, not bz2 or lz4")
    ],
    "xdf": [Case(_pickled(_session, "a.xdf"), "a.xdf")],
    "hdf5": [Case(_filter, "filter 31999, which is not read")],
    "zarr": [
        Case(
            _zarr_array({**V2, "dtype": "|O", "filters": [{"id": "pickle"}]}, pickle.dumps(Runs())),
            "codec 'pickle', which is not read",
            RATE,
        ),
        Case(
            _zarr_array({**V2, "dtype": "<f8", "filters": None, "compressor": {"id": "pickle"}}, pickle.dumps(Runs())),
            "codec 'pickle', which is not read",
            RATE,
        ),
        Case(
            _zarr_array({**V3, "codecs": [{"name": "sharding_indexed", "configuration": SHARDS}]}, b"", 3),
            "codec 'pickle', which is not read",
            RATE,
        ),
    ],
    "table": [Case(_archive(t=T, a=np.array([Runs()] * 3)), "holds Python objects", LAYOUT % "npz")],
    "biotac-slide": [Case(_pickled(slide_files.write_biotac, "*_bio.csv"), "_bio.csv")],
    "roboskin": [
        Case(
            lambda place: np.save(slide_files.write_roboskin(place, slide_files.touched(1, 20)), np.array([Runs()])),
            "icub_fold_0.npy",
        )
    ],
    "gelsight-slip": [Case(_pickled(video_files.write_gelsight, "camera_2.avi"), "camera_2.avi")],
    "vision2tactile": [Case(_pickled(grasp_files.write_grasp, "tactile.tac"), "tactile.tac")],
    "xela-flat": [
        Case(_pickled(lambda place: xela_files.write_flat(place / "trial"), "xela_sensor1.csv"), "xela_sensor1.csv")
    ],
    "xela-psc": [
        Case(_pickled(lambda place: xela_files.write_psc(place / "trial"), "xela_sensor1.csv"), "xela_sensor1.csv")
    ],
}


@pytest.mark.parametrize(("reader", "case"), every_case(RUNS_CODE))
def test_no_codec_of_a_file_runs_code(lab: Lab, reader: str, case: Case) -> None:
    ask(lab, reader, case, "a codec that runs code")
    assert not (lab.folder / "ran").exists()


# ---- A size that a file only declares


def _wide_template(folder: Path) -> None:
    lerobot_files.write_v2(folder / "set")
    path = folder / "set" / "meta" / "info.json"
    about = json.loads(path.read_text()) | {"data_path": "data/{episode_index:02000000000d}.parquet"}
    path.write_text(json.dumps(about))


def _long_texts(path: Path, columns: dict[str, Any], rows: int) -> None:
    """Write a table whose texts are one of a megabyte, which its dictionary has once."""
    text = pa.DictionaryArray.from_arrays(pa.array(np.zeros(rows, np.int32)), pa.array(["x" * 1_000_000]))
    schema = pa.schema([("text", pa.dictionary(pa.int32(), pa.string())), *((name, pa.float64()) for name in columns)])
    pq.write_table(pa.table({"text": text, **columns}, schema), path)


def _long_texts_of_episodes(folder: Path) -> None:
    lerobot_files.write_v3(folder / "set")
    _long_texts(next((folder / "set" / "meta" / "episodes").rglob("*.parquet")), {}, 4000)


def _many_chunks(folder: Path) -> None:
    array_files.store(folder / "a.zarr").create_group("data")
    (folder / "a.zarr" / "data" / "a").mkdir()
    about = {**V2, "shape": [4_000_000_000], "chunks": [1], "dtype": "<f8", "filters": None}
    (folder / "a.zarr" / "data" / "a" / ".zarray").write_text(json.dumps(about))


def _large_chunk(folder: Path) -> None:
    about = {**V2, "shape": [500_000_000], "chunks": [500_000_000], "dtype": "<f8", "filters": None}
    _zarr_array(about, b"")(folder)


def _bomb_chunk(codec: str) -> Callable[[Path], None]:
    """Return a function that writes a chunk of 80 values which unpacks to 1 GB."""

    def write(folder: Path) -> None:
        about = {**V2, "dtype": "<f8", "filters": None, "compressor": {"id": codec, "level": 1}}
        block = bytes(1 << 24)
        if codec == "zstd":
            packed = zstandard.ZstdCompressor().compressobj()
            chunk = b"".join([packed.compress(block) for _ in range(64)]) + packed.flush()
        else:
            zipped = zlib.compressobj(wbits=31)
            chunk = b"".join([zipped.compress(block) for _ in range(64)]) + zipped.flush()
        _zarr_array(about, chunk)(folder)

    return write


def _repeated_text(attribute: bool) -> Callable[[Path], None]:
    """Return a function that writes 3,000 references to one text of a megabyte: 3 GB."""

    def write(folder: Path) -> None:
        mark = "a mark of the text"
        rows = 3000
        with h5py.File(folder / "a.hdf5", "w") as file:
            group = file.create_group("demo_0")
            group["t_s"] = np.arange(float(rows))
            texts = np.array([mark + "x" * 1_000_000] + ["y"] * (rows - 1), dtype=object)
            if attribute:
                group["a"] = np.arange(float(rows))
                group.attrs.create("note", texts, dtype=h5py.string_dtype())
            else:
                group.create_dataset("a", data=texts, dtype=h5py.string_dtype())
        content = (folder / "a.hdf5").read_bytes()
        length = struct.pack("<I", len(mark) + 1_000_000)
        at = next(
            place for place in _places(content, length) if content[place + 16 : place + 20] == struct.pack("<I", 1)
        )
        changed = bytearray(content)
        changed[at : at + 16 * rows] = content[at : at + 16] * rows
        (folder / "a.hdf5").write_bytes(changed)

    return write


def _places(content: bytes, part: bytes) -> Iterator[int]:
    at = content.find(part)
    while at >= 0:
        yield at
        at = content.find(part, at + 1)


def _doubled_links(folder: Path) -> None:
    with h5py.File(folder / "a.hdf5", "w") as file:
        group = file.create_group("demo_0")
        group["t_s"] = group["a"] = np.arange(5.0)
        for _ in range(29):
            inner = group.create_group("left")
            group["right"] = inner
            group = inner


def _sparse(folder: Path) -> None:
    with h5py.File(folder / "a.hdf5", "w") as file:
        file.create_dataset("demo_0/a", shape=(10**12,), chunks=(1000,), dtype="f8")
        file["demo_0"].attrs["rate_hz"] = 100.0


def _wide_array(folder: Path) -> None:
    with zipfile.ZipFile(folder / "a.npz", "w") as archive:
        for name, shape in (("t", (0,)), ("a", (0, 3_000_000_000))):
            with archive.open(f"{name}.npy", "w") as file:
                np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": shape})


def _long_name(folder: Path) -> None:
    (folder / "x.csv").write_text(f"t,{'a_' * 30_000}!\n0,1\n")


def _query(folder: Path) -> None:
    _database_damaged(folder)
    path = folder / "a" / "a.db3"
    path.unlink()
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("CREATE TABLE topics (id INTEGER, name TEXT, type TEXT, serialization_format TEXT)")
        connection.execute("INSERT INTO topics VALUES (1, '/a', 'std_msgs/msg/Float64', 'cdr')")
        connection.execute(
            "CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) "
            "SELECT id, 1 AS topic_id, id AS timestamp, zeroblob(1000000) AS data FROM n"
        )


def _zipped_mcap(folder: Path) -> None:
    """Write an MCAP file with a record of 3 GB of zeros, in 100 kB."""
    content = b"\x89MCAP0\r\n" + struct.pack("<BQ", 5, 3 << 30)
    packed = zstandard.ZstdCompressor().compressobj()
    block = bytes(1 << 24)
    parts = [packed.compress(content), *(packed.compress(block) for _ in range(192)), packed.flush()]
    (folder / "a.mcap.zstd").write_bytes(b"".join(parts))


def _large_chunk_of_mcap(folder: Path) -> None:
    _chunk_damaged(
        CompressionType.ZSTD, lambda content, at, _: content.__setitem__(slice(at + 20, at + 24), b"\1\0\0\0")
    )(folder)


def _zipped_session(folder: Path) -> None:
    session = xdf_writer.Writer()
    session.stream(1, "force", "int16", 2_000_000_000)
    zipped = zlib.compressobj(wbits=31)
    (folder / "a.xdfz").write_bytes(zipped.compress(session.bytes) + zipped.flush())


def _overlong_number(write: Callable[[Path], object], name: str) -> Callable[[Path], None]:
    """Return a function that writes a source in which a number stands for one of 10^12 digits."""

    def overlong(folder: Path) -> None:
        write(folder)
        path = next(path for path in sorted(folder.rglob(name)) if path.is_file())
        before, _, last = path.read_text().rstrip("\n").rpartition("\n")
        path.write_text(f"{before}\n{last.rpartition(',')[0]},1e1000000000000\n")

    return overlong


def _many_points(folder: Path) -> None:
    grasp_files.write_grasp(folder)
    path = next(path for path in sorted(folder.rglob("*.pcd")) if path.is_file())
    path.write_bytes(re.sub(rb"POINTS \d+", b"POINTS 1000000000000", path.read_bytes()))


def _large_frames(folder: Path) -> None:
    """Write a trial with a video whose headers and JPEG images state 16,000 x 16,000 pixels."""
    path = videos.write(video_files.write_gelsight(folder) / "camera_0.avi", "mjpeg", video_files.FRAMES + 1)
    content, side_px = path.read_bytes(), 16_000
    for kind, sides in (("<II", (videos.WIDTH, videos.HEIGHT)), (">HH", (videos.HEIGHT, videos.WIDTH))):
        assert struct.pack(kind, *sides) in content
        content = content.replace(struct.pack(kind, *sides), struct.pack(kind, side_px, side_px))
    path.write_bytes(content)


AT_ONCE = "declares .* GB that would be read at once"
DECLARED: dict[str, list[Case] | str] = {
    "lerobot": [Case(_wide_template, "data_path|not there"), Case(_long_texts_of_episodes, AT_ONCE)],
    "mcap": [Case(_large_chunk_of_mcap, r"declares [\d,]+ bytes, more than the 268,435,456 that are unpacked")],
    "rosbag": [
        Case(_query, "has no table messages"),
        Case(_zipped_mcap, "declares 3,221,225,472 bytes, more than the 268,435,456 that are read"),
    ],
    "xdf": [Case(_zipped_session, "channel_count is '2000000000'")],
    "hdf5": [
        Case(_repeated_text(attribute=False), "unpacks to more than"),
        Case(_repeated_text(attribute=True), "unpacks to more than"),
        Case(_doubled_links, "is the group demo_0/left, which is read there"),
        Case(_sparse, "declares 8,000.0 GB of values and holds 0"),
    ],
    "zarr": [
        Case(_many_chunks, r"declares [\d,]+ chunks", RATE),
        Case(_large_chunk, "has chunks of 4.0 GB, which is not read", RATE),
        Case(_bomb_chunk("zstd"), "unpacks to more than", RATE),
        Case(_bomb_chunk("gzip"), "unpacks to more than", RATE),
    ],
    "table": [
        Case(_wide_array, "has 3,000,000,000 values a row", LAYOUT % "npz"),
        Case(_long_name, "the name of column 2 has 60,001 characters", LAYOUT % "csv"),
        Case(
            lambda folder: _long_texts(folder / "x.parquet", {"t": np.arange(4000.0), "a": np.ones(4000)}, 4000),
            AT_ONCE,
            (LAYOUT % "parquet").replace("[{", '[{ match = "text", type = "text" }, {'),
        ),
    ],
    "biotac-slide": [Case(_overlong_number(slide_files.write_biotac, "*_bio.csv"), "_bio.csv")],
    "roboskin": [
        Case(
            lambda place: slide_files.write_roboskin(place, slide_files.touched(1, 20)).write_bytes(
                b"\x93NUMPY\x01\x00v\x00"
                + b"{'descr': '<f4', 'fortran_order': False, 'shape': (200, 6, 10, 750000000), }".ljust(117)
                + b"\n"
            ),
            "icub_fold_0.npy",
        )
    ],
    "gelsight-slip": [Case(_large_frames, "they have more than 16,777,216 pixels")],
    "vision2tactile": [Case(_many_points, ".pcd")],
    "xela-flat": [
        Case(
            _overlong_number(lambda place: xela_files.write_flat(place / "trial"), "xela_sensor1.csv"),
            "xela_sensor1.csv",
        )
    ],
    "xela-psc": [
        Case(
            _overlong_number(lambda place: xela_files.write_psc(place / "trial"), "xela_sensor1.csv"),
            "xela_sensor1.csv",
        )
    ],
}


@pytest.mark.parametrize(("reader", "case"), every_case(DECLARED))
def test_a_declared_size_takes_no_memory(lab: Lab, reader: str, case: Case) -> None:
    def call(command: str) -> Ran:
        words = [sys.executable, "-c", peaks.PROGRAM, "{}", *shlex.split(command)]
        process = subprocess.run(words, capture_output=True, text=True)
        out, _, peak_kb = process.stdout.rpartition("peak ")
        assert int(peak_kb) < 500_000
        return Ran(process.returncode, out, process.stderr)

    ask(replace(lab, call=call), reader, case, "a declared size")


QUESTIONS = {
    "two parts with one name": NAMED_TWICE,
    "a damaged block": DAMAGED,
    "a declared size": DECLARED,
    "a path that leads out": LEADS_OUT,
    "a codec that runs code": RUNS_CODE,
}


PAGE = Path(__file__).parents[2] / "docs" / "benchmarks" / "faults.md"


def readers_table() -> str:
    """Return the number of cases of each registered reader and question as a Markdown table."""
    counts = {
        reader: [0 if isinstance(cases[reader], str) else len(cases[reader]) for cases in QUESTIONS.values()]
        for reader in sorted(registry.entry_points()["tacpipe.formats"])
        if registry.provider_of("tacpipe.formats", reader) is None
    }
    rows = {**{f"`{reader}`": numbers for reader, numbers in counts.items()}}
    rows["in all"] = [sum(numbers) for numbers in zip(*counts.values(), strict=True)]
    lines = [f"| {name} | {' | '.join(str(number or '–') for number in numbers)} |" for name, numbers in rows.items()]
    return "\n".join([f"| reader | {' | '.join(QUESTIONS)} |", f"| ---{' | ---:' * len(QUESTIONS)} |", *lines])


def test_the_page_of_faults_has_a_row_for_every_reader() -> None:
    assert readers_table() in PAGE.read_text()


@pytest.mark.parametrize("question", list(QUESTIONS))
def test_every_reader_is_asked(question: str) -> None:
    assert set(QUESTIONS[question]) == set(registry.entry_points()["tacpipe.formats"])


# ---- An exception that nothing anticipated


def _cut_workbook(folder: Path) -> None:
    _workbook(folder, lambda sheet: sheet[: len(sheet) // 2])


def _changed_sheet(old: bytes, new: bytes) -> Callable[[Path], None]:
    def change(sheet: bytes) -> bytes:
        assert old in sheet
        return sheet.replace(old, new, 1)

    return lambda folder: _workbook(folder, change)


def _entity_bomb(folder: Path) -> None:
    entities = "".join(f'<!ENTITY e{n} "{f"&e{n - 1};" * 10 if n else "a" * 40}">' for n in range(9))
    bomb = f'<?xml version="1.0"?><!DOCTYPE a [{entities}]><worksheet><v>&e8;</v></worksheet>'
    _workbook(folder, lambda _: bomb.encode())


def _workbook(folder: Path, change: Callable[[bytes], bytes]) -> None:
    """Write a sound workbook, and one whose sheet is changed."""
    book = openpyxl.Workbook()
    for row in (["t", "a"], [0, 1], [1, 2]):
        book.worksheets[0].append(row)
    book.save(folder / "sound.xlsx")
    with zipfile.ZipFile(folder / "sound.xlsx") as sound, zipfile.ZipFile(folder / "bad.xlsx", "w") as bad:
        for name in sound.namelist():
            content = sound.read(name)
            bad.writestr(name, change(content) if name.endswith("sheet1.xml") else content)


def _wrong_shape(shape: list[int]) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        lerobot_files.write_v2(folder / "sound")
        lerobot_files.write_v2(folder / "bad")
        path = folder / "bad" / "meta" / "info.json"
        about = json.loads(path.read_text())
        about["features"]["action"]["shape"] = shape
        path.write_text(json.dumps(about))

    return write


def _video_of_text(folder: Path) -> None:
    lerobot_files.write_v2(folder / "sound", episodes=1)
    lerobot_files.write_v2(folder / "bad", episodes=1)
    path = folder / "bad" / "meta" / "info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"video_path": "{video_key}.txt"}))
    (folder / "bad" / "observation.images.top.txt").write_text("no video")


@pytest.mark.parametrize(
    ("reader", "case"),
    [
        ("table", Case(_cut_workbook, r"left out bad: bad\.xlsx cannot be read: ParseError", LAYOUT % "xlsx")),
        ("table", Case(_entity_bomb, r"left out bad: bad\.xlsx cannot be read: ParseError", LAYOUT % "xlsx")),
        ("table", Case(_changed_sheet(b'r="2"', b'r="9999999"'), "row 9999999 follows row 1, has a", LAYOUT % "xlsx")),
        ("table", Case(_changed_sheet(b'"B3"', b'"A3"'), "row 3 follows row 2, .* two of one column", LAYOUT % "xlsx")),
        ("table", Case(_changed_sheet(b'r="3"', b'r="2"'), "row 2 follows row 2", LAYOUT % "xlsx")),
        ("table", Case(_changed_sheet(b't="n"', b't="s"'), "there is no text|list index", LAYOUT % "xlsx")),
        ("table", Case(_changed_sheet(b't="n"', b't="x"'), "has a cell of the unknown type 'x'", LAYOUT % "xlsx")),
        ("lerobot", Case(_wrong_shape([2**62, 2**62]), "left out bad: bad/meta/info.json: the feature action")),
        ("lerobot", Case(_wrong_shape([-1]), "left out bad: bad/meta/info.json: the feature action")),
        ("lerobot", Case(_video_of_text, r"left out bad-episode_000000: .*top\.txt cannot be read as a video")),
    ],
)
def test_a_file_with_an_unusual_fault_costs_its_own_recording(lab: Lab, reader: str, case: Case) -> None:
    ask(lab, reader, replace(case, option="--skip-bad"), "an unusual fault")


@pytest.mark.parametrize("place", ["discover", "call", "batches"])
def test_any_exception_of_a_reader_names_its_files(lab: Lab, monkeypatch: pytest.MonkeyPatch, place: str) -> None:
    def fail(*_: object, **__: object) -> Any:
        raise ZeroDivisionError("one line\nand more")

    target = {"discover": "find_recordings", "call": "read_streams", "batches": "_note_rate"}[place]
    monkeypatch.setattr(recordings, target, fail)
    (lab.folder / "lab").mkdir()
    (lab.folder / "lab/x.csv").write_text("t,a\n0,1\n1,2\n")
    (lab.folder / "layout.toml").write_text(LAYOUT % "csv")
    command = "ingest table lab --layout layout.toml -o out --skip-bad"
    ran = lab.call(command)
    source = "lab" if place == "discover" else r"x\.csv"
    assert ran.code == 1
    assert re.search(rf"{source} cannot be read: ZeroDivisionError: one line\. Copy it again", ran.err), ran.err
    assert "Traceback" not in ran.err
    monkeypatch.setenv("TACPIPE_TRACEBACK", "1")
    with pytest.raises(ZeroDivisionError):
        lab.call(command)


def test_an_exception_in_code_of_tacpipe_is_called_a_defect(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recordings, "read_streams", None)
    (lab.folder / "lab").mkdir()
    (lab.folder / "lab/x.csv").write_text("t,a\n0,1\n1,2\n")
    (lab.folder / "layout.toml").write_text(LAYOUT % "csv")
    ran = lab.call("ingest table lab --layout layout.toml -o out")
    assert ran.code == 1 and "x.csv cannot be read: TypeError" in ran.err
    assert "This is a defect of tacpipe: report it with the traceback that TACPIPE_TRACEBACK=1 shows" in ran.err


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ShortageError("no memory"), OSError(5, "Input/output error")])
def test_what_is_no_fault_of_a_file_passes_the_boundary(error: BaseException) -> None:
    with pytest.raises(type(error)) as raised, failures.naming_source(["a.csv"]):
        raise error
    assert raised.value is error


def test_a_failure_outside_of_readers_stays_loud(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(computing, "_stored_columns", None)
    (lab.folder / "lab").mkdir()
    (lab.folder / "lab/x.csv").write_text("t,a\n0,1\n1,2\n")
    (lab.folder / "layout.toml").write_text(LAYOUT % "csv")
    with pytest.raises(TypeError) as raised:
        lab.call("ingest table lab --layout layout.toml -o out --skip-bad")
    assert raised.value.__notes__ == ["This is a defect of tacpipe: report it with the traceback."]
