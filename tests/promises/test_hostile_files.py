"""Test that files with false claims, with programs, or of other types are rejected before memory is allocated."""

import io
import os
import pickle
import re
import struct
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tacpipe.clouds import files as cloud_files
from tacpipe.clouds import point_files
from tacpipe.errors import DamagedError, ShortageError, TacpipeError
from tacpipe.formats import csv_table
from tacpipe.io import parquet_claims
from tacpipe.io.parquet import from_parquet, to_parquet
from tests.conftest import Lab, without_created_store
from tests.promises import targets
from tests.promises.counts import count
from tests.promises.limits import GIB, bound_memory, is_sentence, sample_cases

SMALL = GIB // 2  # memory that refusing a file may take, libraries that it loads included
XYZ = "property float x\nproperty float y\nproperty float z\n"


def check_refusal(
    read: Callable[[], object], match: str | None = None, kind: type[TacpipeError] = TacpipeError
) -> None:
    """A reader refuses with a sentence, within little memory."""
    with bound_memory(SMALL), pytest.raises(kind, match=match) as error:
        read()
    assert is_sentence(str(error.value)), str(error.value)
    count("hostile inputs refused")


def varint(number: int) -> bytes:
    """Return a whole number as Thrift's compact protocol writes it."""
    number, encoded = number << 1, b""
    while number >= 128:
        encoded, number = encoded + bytes([number & 127 | 128]), number >> 7
    return encoded + bytes([number])


def with_footer(content: bytes, footer: bytes) -> bytes:
    """Return a Parquet file with another footer."""
    length = struct.unpack("<I", content[-8:-4])[0]
    return content[: -8 - length] + footer + struct.pack("<I", len(footer)) + b"PAR1"


def footer_of(content: bytes) -> bytes:
    return content[-8 - struct.unpack("<I", content[-8:-4])[0] : -8]


# ---- Parquet


@pytest.mark.parametrize("rows", [10**6, 10**9, 10**12, 1 << 62])
def test_rows_that_a_parquet_file_only_claims_are_not_believed(rows: int) -> None:
    content = to_parquet(pa.table({"t_ns": np.arange(77)}))
    footer = footer_of(content)
    row_count = b"\x16" + varint(77)  # The count of the file, its group, and the column's values.
    assert footer.count(row_count) >= 3
    check_refusal(
        lambda: from_parquet(with_footer(content, footer.replace(row_count, b"\x16" + varint(rows)))),
        "77",
        DamagedError,
    )


@pytest.mark.parametrize("rows", [-1, -(10**12)])
def test_a_negative_number_of_rows_is_refused(rows: int) -> None:
    content = to_parquet(pa.table({"t_ns": np.arange(77)}))
    row_count = b"\x16" + varint(77)
    number = (rows << 1) ^ -1
    encoded = b""
    while number >= 128:
        encoded, number = encoded + bytes([number & 127 | 128]), number >> 7
    check_refusal(
        lambda: from_parquet(
            with_footer(content, footer_of(content).replace(row_count, b"\x16" + encoded + bytes([number])))
        ),
        kind=DamagedError,
    )


@pytest.mark.parametrize("size", [10**9, (1 << 31) - 1])
def test_a_page_that_claims_to_unpack_to_gigabytes_is_held_against_the_memory(
    size: int, leave_memory: Callable[[int], None]
) -> None:
    content = to_parquet(pa.table({"t_ns": np.arange(5)}))
    header = parquet_claims._USUAL.match(content, 4)
    assert header is not None
    bomb = content[: header.start(1)] + varint(size) + content[header.end(1) :]
    shift = len(varint(size)) - len(header[1])
    column_size = b"\x16" + varint(_size(content))  # the column's size in the file
    assert column_size in footer_of(content)
    bomb = with_footer(bomb, footer_of(content).replace(column_size, b"\x16" + varint(_size(content) + shift)))
    leave_memory(10**8)
    check_refusal(lambda: from_parquet(bomb), "declares", ShortageError)


def _size(content: bytes) -> int:
    return int(pq.ParquetFile(io.BytesIO(content)).metadata.row_group(0).column(0).total_compressed_size)


BOMB_ROWS = 80_000_000


@pytest.fixture(scope="module")
def bomb() -> bytes:
    """Some hundred kilobytes that are 640 MB once it is read: zeros, as a sensor that holds still gives them."""
    sink = io.BytesIO()
    table = pa.table({"t_ns": pa.array(np.zeros(1 << 20, np.int64))})
    with pq.ParquetWriter(sink, table.schema, use_dictionary=False, compression="zstd") as writer:
        for _ in range(BOMB_ROWS >> 20):
            writer.write_table(table)
    return sink.getvalue()


def test_a_file_that_unpacks_to_more_than_the_memory_is_refused_before_it_is_unpacked(bomb: bytes) -> None:
    assert len(bomb) < 800_000
    check_refusal(lambda: from_parquet(bomb), r"declares 0\.6 GB of data.*do not use it", ShortageError)


def test_a_long_recording_that_held_still_is_read_where_there_is_memory_for_it(bomb: bytes) -> None:
    content = to_parquet(pa.table({"t_ns": np.arange(2_000_000), "taxel": np.full(2_000_000, 7, np.uint16)}))
    assert len(content) < 40_000
    with bound_memory(GIB):
        assert from_parquet(content).column("taxel").to_numpy().sum() == 14_000_000


@pytest.mark.parametrize("encoding", sample_cases(["PLAIN_DICTIONARY", "DELTA_BYTE_ARRAY"], 1))
def test_texts_that_stand_for_a_million_long_ones_are_refused(encoding: str) -> None:
    text, rows, sink = "x" * 1_000_000, 100_000, io.BytesIO()
    array = pa.DictionaryArray.from_arrays(pa.array(np.zeros(rows, np.int32)), pa.array([text]))
    if encoding == "PLAIN_DICTIONARY":
        pq.write_table(pa.table({"a": array}), sink, compression="zstd")
    else:
        short = pa.table({"a": [text] * 100})
        with pq.ParquetWriter(sink, short.schema, use_dictionary=False, column_encoding={"a": encoding}) as writer:
            for _ in range(8):
                writer.write_table(short)
    assert len(sink.getvalue()) < 40_000_000
    check_refusal(lambda: from_parquet(sink.getvalue()), "declares", ShortageError)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": "snappy", "data_page_version": "2.0"},
        {"compression": "gzip", "write_statistics": True, "data_page_size": 100},
        {"use_dictionary": False, "write_page_checksum": True, "compression": "none"},
    ],
)
def test_files_of_other_programs_are_read_as_they_are(options: dict[str, Any]) -> None:
    rng = np.random.default_rng(0)
    columns = {
        "number": rng.normal(size=3000),
        "text": [f"word {n % 7}" * (n % 3) for n in range(3000)],
        "nothing": pa.array([None] * 3000, pa.int32()),
        "flag": rng.random(3000) < 0.5,
        "list": [list(range(n % 5)) for n in range(3000)],
        "four": pa.array([b"abcd"] * 3000, pa.binary(4)),
    }
    table, sink = pa.table(columns), io.BytesIO()
    pq.write_table(table, sink, **options)
    assert from_parquet(sink.getvalue()).equals(table)
    assert from_parquet(sink.getvalue(), ["text"]).equals(table.select(["text"]))


# ---- clouds


def cloud(tmp_path: Path, name: str, content: bytes) -> Callable[[], object]:
    (tmp_path / name).write_bytes(content)
    return lambda: cloud_files.read(tmp_path / name)


PCD = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"


@pytest.mark.parametrize("points", ["1000000000000", "-5", "1e9", "9" * 5000, "0x10", ""])
@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_points_that_a_pcd_file_only_claims_are_refused(tmp_path: Path, points: str, data: str) -> None:
    check_refusal(cloud(tmp_path, "a.pcd", f"{PCD}POINTS {points}\nDATA {data}\n1 2 3\n".encode()), r"a\.pcd")


@pytest.mark.parametrize("size", ["1000000000000", "99999999", "0", "-1"])
@pytest.mark.parametrize("data", ["ascii", "binary"])
def test_a_field_of_a_pcd_point_that_is_absurdly_wide_is_refused(tmp_path: Path, size: str, data: str) -> None:
    head = f"VERSION 0.7\nFIELDS x y z q\nSIZE 4 4 4 8\nTYPE F F F F\nCOUNT 1 1 1 {size}\nPOINTS 20\nDATA {data}\n"
    check_refusal(cloud(tmp_path, "a.pcd", head.encode() + b"1 2 3\n" * 20), r"a\.pcd")


@pytest.mark.parametrize(
    ("packed", "unpacked", "points"),
    [(10, 0xFFFFFFFF, 10**9), (0xFFFFFFFF, 12, 1), (5, 12 * 10**6, 10**6), (5, 24, 1), (0, 12, 1), (5, 12, 10**9)],
)
def test_sizes_of_compressed_points_that_lie_are_refused(
    tmp_path: Path, packed: int, unpacked: int, points: int
) -> None:
    head = f"{PCD}WIDTH {points}\nHEIGHT 1\nPOINTS {points}\nDATA binary_compressed\n".encode()
    check_refusal(cloud(tmp_path, "a.pcd", head + struct.pack("<II", packed, unpacked) + bytes(5)), r"a\.pcd declares")


@pytest.mark.parametrize("points", ["1000000000000", "-5", "1e9", "9" * 5000, ""])
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_points_that_a_ply_file_only_claims_are_refused(tmp_path: Path, points: str, form: str) -> None:
    content = f"ply\nformat {form} 1.0\nelement vertex {points}\n{XYZ}end_header\n1 2 3\n".encode()
    check_refusal(cloud(tmp_path, "a.ply", content), r"a\.ply")
    check_refusal(lambda: point_files.parse_ply(Path("a.ply"), content), r"a\.ply")


@pytest.mark.parametrize("element", ["face 1000000000000", "face 1"])
def test_lists_before_the_points_of_a_ply_file_are_not_believed(tmp_path: Path, element: str) -> None:
    lists = f"element {element}\nproperty list uchar int vertex_indices\n"
    content = f"ply\nformat binary_little_endian 1.0\n{lists}element vertex 1000000000000\n{XYZ}end_header\n1 2 3\n"
    check_refusal(cloud(tmp_path, "a.ply", content.encode()), r"a\.ply")


def test_headers_that_overran_the_memory_of_open3d_are_refused(tmp_path: Path) -> None:
    for word in ("x" * 300, "x" * 3000, "\N{SNOWMAN}" * 400):
        content = (
            f"ply\nformat ascii 1.0\ncomment {word}\nelement vertex 1\n{XYZ}property float {word}\nend_header\n1 2\n"
        )
        check_refusal(cloud(tmp_path, "a.ply", content.encode()), r"a\.ply")


@pytest.mark.parametrize("count", ["1000000000000", "100000000", "9" * 5000])
def test_points_that_a_pts_file_only_claims_are_refused(tmp_path: Path, count: str) -> None:
    check_refusal(cloud(tmp_path, "a.pts", f"{count}\n1 2 3\n".encode()), r"a\.pts")


def test_one_long_number_among_many_does_not_take_its_length_for_each() -> None:
    rows = b"1" * 1_000_000 + b" 1 1\n" + b"1 1 1\n" * 99_999
    head = f"{PCD}POINTS 100000\nDATA ascii\n".encode()
    text = f"ply\nformat ascii 1.0\nelement vertex 100000\n{XYZ}end_header\n".encode()
    for read, content in ((point_files.parse_pcd, head + rows), (point_files.parse_ply, text + rows)):
        with bound_memory(SMALL):
            xyz, _ = read(Path("a"), content)
        assert np.isinf(xyz[0, 0]) and xyz[0, 1:].tolist() == [1, 1] and (xyz[1:] == 1).all()


# ---- arrays


def array(shape: str, kind: str = "'<f4'", body: bytes = bytes(64)) -> bytes:
    head = f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    head += b" " * (63 - (len(head) + 10) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + body


ARRAYS = {
    "a million slides": array("(1000000000000, 6, 10, 75)"),
    "slides of no width": array("(1000000000000, 0, 10, 75)"),
    "fewer than none": array("(-3, 6, 10, 75)"),
    "a fraction": array("(1.5, 6, 10, 75)"),
    "a text": array("('a', 6, 10, 75)"),
    "more digits than a number has": array(f"({'9' * 5000}, 6, 10, 75)"),
    "objects": array("(1, 6, 10, 75)", "'|O'", bytes(4 * 4500)),
    "structures": array("(1, 6, 10, 75)", "[('a', '<f4')]", bytes(4 * 4500)),
    "a head of gigabytes": b"\x93NUMPY\x02\x00" + struct.pack("<I", 0xFFFFFFF0) + bytes(100),
    "brackets": b"\x93NUMPY\x02\x00" + struct.pack("<I", 9000) + b"(" * 9000,
    "a call": array("__import__('os').system('touch opened')"),
    "an archive": b"PK\x03\x04" + bytes(100),
    "nothing": b"",
}


@pytest.mark.parametrize("case", ARRAYS)
@pytest.mark.parametrize("name", ["icub_fold_0.npy", "labels_fold_0.npy"])
def test_arrays_whose_heads_lie_are_refused(
    tmp_path: Path, case: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    targets.TREES["roboskin"](tmp_path)
    (tmp_path / name).write_bytes(ARRAYS[case])
    check_refusal(lambda: targets.ingest_recordings("roboskin", tmp_path), name)
    assert not (tmp_path / "opened").exists()


@pytest.mark.parametrize("name", ["icub_fold_0.npy", "labels_fold_0.npy"])
@pytest.mark.parametrize("form", ["bare", "as an array of objects"])
def test_a_pickle_in_place_of_an_array_is_never_opened(tmp_path: Path, name: str, form: str) -> None:
    targets.TREES["roboskin"](tmp_path)
    trace = tmp_path / "opened"
    if form == "bare":
        (tmp_path / name).write_bytes(pickle.dumps(targets.Opened(trace)))
    else:
        value = np.empty(1, dtype=object)
        value[0] = targets.Opened(trace)
        np.save(tmp_path / name, value, allow_pickle=True)
    check_refusal(lambda: targets.ingest_recordings("roboskin", tmp_path), name)
    assert not trace.exists()
    np.load(tmp_path / name, allow_pickle=True)  # A careless reader does this.
    assert trace.exists()


# ---- text


WIDE = 200_000
TEXTS: dict[str, bytes] = {
    "empty": b"",
    "one line": b"a,b,c",
    "a header of many columns": b",".join(b"c%d" % n for n in range(WIDE)) + b"\n1\n",
    "a header of one name over and over": b",".join([b"same"] * WIDE) + b"\n1\n",
    "a name of a megabyte": b"x" * 1_000_000 + b",b\n1,2\n",
    "a cell of a megabyte": b"a,b,c\n1,2," + b"9" * 1_000_000 + b"\n",
    "a quote that never ends": b'a,b,c\n1,2,"' + b"x\n" * 300_000,
    "bytes of no text": bytes(range(256)) * 50,
    "zeros": b"a,b,c\n1,\0,3\n",
    "only zeros": bytes(10_000),
    "two encodings": "a,b,c\n1,ä,3\n".encode() + "1,ä,3\n".encode("latin-1"),
    "UTF-16": "a,b,c\n1,2,3\n".encode("utf-16"),
    "a row of many cells": b"a,b,c\n" + b"1," * 1_000_000 + b"\n",
    "a terminal's commands": b"a\x1b[2J,\x1b]0;title\x07,c\n1,\x1b[31m,3\n",
    "commas": b"," * 100_000,
    "returns": b"\r" * 100_000 + b"a,b,c\r1,2,3",
    "a number too large": b"a,b,c\n1,2,1e999\n",
}


@pytest.mark.parametrize("name", TEXTS)
@pytest.mark.parametrize(
    "options", sample_cases([{}, {"integers": pa.uint16()}, {"trailing_comma": True}, {"seconds": "a"}], 1)
)
def test_text_that_is_no_table_is_refused(tmp_path: Path, name: str, options: dict[str, Any]) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(TEXTS[name])
    columns = ["b", "c"] if "seconds" in options else ["a", "b", "c"]
    check_refusal(lambda: csv_table.read_csv(path, columns, **options), r"a\.csv")


# ---- what is no file


def replace_by(kind: str, path: Path) -> None:
    """Put something else in the place of a file."""
    path.unlink()
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        places = {"device": "/dev/null", "endless": "/dev/zero", "nothing": "/nowhere", "circle": str(path)}
        path.symlink_to(places[kind])


def check_source_with(lab: Lab, name: str, kind: str) -> None:
    """Each file of a source in turn is something else; what is ingested is refused, or leaves that recording out."""
    (lab.folder / "source").mkdir()
    targets.TREES[name](lab.folder / "source")
    path = sorted(file for file in (lab.folder / "source").rglob("*") if file.is_file())[0]
    replace_by(kind, path)
    with bound_memory(4 * GIB):
        ran = targets.ingest(lab, name)
    assert ran.code in (1, 2)
    said = without_created_store(ran.err).removeprefix("tacpipe: ").rstrip("\n")
    assert is_sentence(re.sub(r"^  \S+: +read, \d+ rows\n", "", said, flags=re.MULTILINE)), ran.err
    assert not (lab.folder / "data").exists()
    count("hostile inputs refused")


@pytest.mark.parametrize("name", ["roboskin", "vision2tactile", "xela-flat"])
@pytest.mark.parametrize("kind", ["pipe", "endless"])
def test_what_is_no_file_in_a_published_source_is_refused_and_not_waited_for(lab: Lab, name: str, kind: str) -> None:
    check_source_with(lab, name, kind)


@pytest.mark.faults
@pytest.mark.parametrize("name", targets.TREES)
@pytest.mark.parametrize("kind", ["folder", "pipe", "device", "endless", "nothing", "circle"])
def test_nothing_that_stands_in_place_of_a_published_file_is_waited_for(lab: Lab, name: str, kind: str) -> None:
    check_source_with(lab, name, kind)


@pytest.mark.parametrize("suffix", cloud_files.SUFFIXES)
def test_a_pipe_or_a_device_is_no_cloud(tmp_path: Path, suffix: str) -> None:
    os.mkfifo(tmp_path / f"a{suffix}")
    (tmp_path / f"b{suffix}").symlink_to("/dev/zero")
    for name in "ab":
        check_refusal(lambda name=name: cloud_files.read(tmp_path / f"{name}{suffix}"), "not a file")  # type: ignore[misc]


def test_a_file_of_a_pipe_is_refused_though_somebody_writes_it(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.csv")
    writer = threading.Thread(target=lambda: os.close(os.open(tmp_path / "a.csv", os.O_RDWR)))
    writer.start()
    check_refusal(lambda: csv_table.read_csv(tmp_path / "a.csv", ["a"]), "a named pipe, not a file")
    writer.join()
