"""MCAP files of JSON and other messages, as mcap's writer wrote them, and one recording in four formats."""

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter

import tacpipe
from tacpipe.errors import TacpipeError
from tacpipe.formats.bags.container import open_bag
from tests.conftest import Lab
from tests.formats.bags import writers
from tests.formats.bags.test_bags import only, read
from tests.formats.bags.writers import START_NS, STEP_NS, mcap_json


def test_json_messages_become_columns_with_the_types_of_their_values(tmp_path: Path) -> None:
    sent = [
        (START_NS + n, {"a": n, "f": n / 2, "ok": n > 1, "name": f"n{n}", "p": {"x": 1.5}, "l": [n, -n]})
        for n in range(3)
    ]
    table = only(mcap_json(tmp_path / "a.mcap", {"/state": sent}))
    assert table.column("t_log_ns").to_pylist() == [START_NS, START_NS + 1, START_NS + 2]
    assert table.drop("t_log_ns").to_pylist()[2] == {
        "a": 2,
        "f": 1.0,
        "ok": True,
        "name": "n2",
        "p_x": 1.5,
        "l_0": 2,
        "l_1": -2,
    }
    assert table.schema.field("a").type == pa.int64()


def test_a_value_that_is_missing_in_some_messages_is_nan(tmp_path: Path) -> None:
    sent: list[tuple[int, Any]] = [
        (START_NS, {"a": 1, "b": 2.5}),
        (START_NS + 1, {"a": None}),
        (START_NS + 2, {"a": 3, "b": 1}),
    ]
    table = only(mcap_json(tmp_path / "a.mcap", {"/state": sent}))
    assert str(table.column("a").to_pylist()) == "[1.0, nan, 3.0]"
    assert str(table.column("b").to_pylist()) == "[2.5, nan, 1.0]"


def test_a_time_in_json_is_the_time_of_the_row(tmp_path: Path) -> None:
    seconds = START_NS // 10**9
    sent = [(START_NS + 500 + n, {"timestamp": {"sec": seconds, "nsec": n}, "v": n}) for n in range(2)]
    (result,) = read(mcap_json(tmp_path / "a.mcap", {"/s": sent})).streams
    assert result.time.column == "t_header_ns"
    assert result.table.column("t_header_ns").to_pylist() == [START_NS, START_NS + 1]


def test_bytes_in_base64_are_kept_as_bytes(tmp_path: Path) -> None:
    schema = {"type": "object", "properties": {"data": {"type": "string", "contentEncoding": "base64"}}}
    frames = [b"\xff\xd8\x00", b"\x01" * 10]
    sent = [
        (START_NS + n, {"data": base64.b64encode(value).decode(), "format": "jpeg"}) for n, value in enumerate(frames)
    ]
    table = only(mcap_json(tmp_path / "a.mcap", {"/camera": sent}, schema))
    assert table.column("data").type == pa.binary()
    assert table.column("data").to_pylist() == frames


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunking", [True, False])
def test_every_compression_with_and_without_chunks_and_indexes(
    tmp_path: Path, compression: Any, chunking: bool
) -> None:
    sent = {"/a": [(START_NS + n, {"v": n}) for n in range(100)]}
    for indexes in (IndexType.ALL, IndexType.NONE):
        path = tmp_path / f"{indexes.value}.mcap"
        mcap_json(path, sent, compression=compression, use_chunking=chunking, index_types=indexes)
        assert only(path).column("v").to_pylist() == list(range(100))


def test_metadata_become_attributes_with_the_types_that_they_are_written_in(tmp_path: Path) -> None:
    path = mcap_json(
        tmp_path / "a.mcap", {"/a": [(START_NS, {"v": 1})]}, metadata={"material": "cork", "trial": "3", "ok": "true"}
    )
    assert read(path).attributes == {"material": "cork", "trial": 3, "ok": True}


def test_messages_of_an_encoding_that_is_not_read_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        good = writer.register_channel("/good", "json", writer.register_schema("s", "jsonschema", b"{}"))
        flat = writer.register_channel("/flat", "flatbuffer", writer.register_schema("t", "flatbuffer", b"\0"))
        bare = writer.register_channel("/bare", "", 0)
        for n in range(3):
            writer.add_message(good, START_NS + n, json.dumps({"v": n}).encode(), START_NS + n)
            for channel in (flat, bare):
                writer.add_message(channel, START_NS + n, b"x", START_NS + n)
        writer.finish()  # type: ignore[no-untyped-call]
    contents = read(path)
    assert [stream.source for stream in contents.streams] == ["/good"]
    assert set(contents.skipped) == {"/flat", "/bare"}
    assert "flatbuffer" in contents.skipped["/flat"]


@pytest.mark.parametrize("message", [b"[1]", b"{", b"\xff", b""])
def test_a_message_that_is_not_an_object_of_json_costs_its_topic(tmp_path: Path, message: bytes) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        for topic, content in (("/bad", message), ("/good", b'{"v": 1}')):
            channel = writer.register_channel(topic, "json", 0)
            writer.add_message(channel, START_NS, content, START_NS)
        writer.finish()  # type: ignore[no-untyped-call]
    contents = read(path)
    assert ([stream.source for stream in contents.streams], list(contents.skipped)) == (["/good"], ["/bad"])


def test_an_attachment_is_named_as_one_that_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        writer.add_attachment(START_NS, START_NS, "calibration.yaml", "text/yaml", b"x" * 10_000)
        writer.add_message(writer.register_channel("/a", "json", 0), START_NS, b'{"v": 1}', START_NS)
        writer.finish()  # type: ignore[no-untyped-call]
    contents = read(path)
    assert len(contents.streams) == 1
    assert "calibration.yaml" in contents.notes[0]


def test_a_publish_time_of_its_own_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        channel = writer.register_channel("/a", "json", 0)
        writer.add_message(channel, START_NS, b'{"v": 1}', START_NS - 7)
        writer.finish()  # type: ignore[no-untyped-call]
    assert only(path).column("t_publish_ns").to_pylist() == [START_NS - 7]


FRAMES = 60
ROWS, COLUMNS = 4, 4
LAYOUT = """
[streams.skin]
{skin}
columns = [{{ match = "{taxels}", name = "taxel{{taxel}}", quantity = "tactile", unit = "count", type = "float32" }}{more}]

[streams.arm]
{arm}
"""


def _recording(trial: int) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return a 4x4 array at 100 Hz and an arm of seven joints at 500 Hz."""
    rng = np.random.default_rng(trial)
    skin = pd.DataFrame(rng.integers(0, 4096, (FRAMES, ROWS * COLUMNS)), columns=[f"data_{n}" for n in range(16)])
    arm = pd.DataFrame({f"joint{n}_rad": rng.normal(size=5 * FRAMES) for n in range(1, 8)})
    skin.insert(0, "t_ns", START_NS + np.arange(FRAMES) * STEP_NS)
    arm.insert(0, "t_ns", START_NS + np.arange(5 * FRAMES) * STEP_NS // 5)
    return skin, arm


def _messages(types: Any, skin: pd.DataFrame, arm: pd.DataFrame) -> list[writers.Sent]:
    sent: list[writers.Sent] = []
    for row in skin.to_numpy():
        message = writers.build(types, "std_msgs/msg/Float32MultiArray", data=row[1:])
        sent.append(("/skin", "std_msgs/msg/Float32MultiArray", int(row[0]), message))
    for t_ns, position in zip(arm["t_ns"], arm.drop(columns="t_ns").to_numpy(), strict=True):
        names = [f"panda_joint{n}" for n in range(1, 8)]
        header = writers.header(types, int(t_ns))
        message = writers.build(types, "sensor_msgs/msg/JointState", header=header, name=names, position=position)
        sent.append(("/joint_states", "sensor_msgs/msg/JointState", int(t_ns) + 300_000, message))
    return sorted(sent, key=lambda entry: entry[2])


def _csv(folder: Path, trial: int) -> None:
    for name, frame in zip(("skin", "arm"), _recording(trial), strict=True):
        (folder / f"t{trial}").mkdir(parents=True, exist_ok=True)
        frame.to_csv(folder / f"t{trial}" / f"{name}.csv", index=False)


def _mcap(folder: Path, trial: int) -> None:
    skin, arm = _recording(trial)
    folder.mkdir(exist_ok=True)
    taxels = [(int(row[0]), {"data": row[1:].tolist()}) for row in skin.to_numpy()]
    joints = [
        (int(row["t_ns"]), {"joint": {str(n): row[f"joint{n}_rad"] for n in range(1, 8)}})
        for row in arm.to_dict("records")
    ]
    mcap_json(folder / f"t{trial}.mcap", {"/skin": taxels, "/joint_states": joints})


def test_one_recording_as_csv_mcap_and_bag_gives_the_same_numbers(lab: Lab) -> None:
    types, types1 = writers.store(), writers.store(ros1=True)
    for trial in range(2):
        skin, arm = _recording(trial)
        _csv(lab.folder / "csv", trial)
        _mcap(lab.folder / "json", trial)
        for storage in writers.STORAGES:
            writers.ros2(lab.folder / storage / f"t{trial}", _messages(types, skin, arm), storage)
        (lab.folder / "ros1").mkdir(exist_ok=True)
        writers.ros1(lab.folder / "ros1" / f"t{trial}.bag", _messages(types1, skin, arm), "LZ4")
    tables = {}
    bag = ('source = "/skin"', "data_{taxel}", "", 'source = "/joint_states"')
    joints = '[{ match = "joint_{n}", name = "joint{n}_rad", quantity = "joint_position", unit = "rad" }]'
    ways = {
        "csv": (
            "table",
            ('files = "{trial}/skin.csv"\ntime = { column = "t_ns", unit = "ns" }', "data_{taxel}", ""),
            'files = "{trial}/arm.csv"\ntime = { column = "t_ns", unit = "ns" }\n'
            'columns = [{ match = "joint{n}_rad", quantity = "joint_position", unit = "rad" }]',
        ),
        "json": ("mcap", ('source = "/skin"', "data_{taxel}", ""), f'source = "/joint_states"\ncolumns = {joints}'),
        **dict.fromkeys(("ros1", *writers.STORAGES), ("rosbag", bag[:3], bag[3])),
    }
    for way, (command, (skin_of, taxels, extra), arm_of) in ways.items():
        text = LAYOUT.format(skin=skin_of, taxels=taxels, more=extra, arm=arm_of)
        (lab.folder / f"{way}.toml").write_text(text)
        lab.run(f"ingest {command} {way} --layout {way}.toml -o data/{way}")
        result = tacpipe.open(lab.folder / "data" / way)
        names = ["t_ns", *(f"taxel{n}" for n in range(16))], ["t_ns", *(f"joint{n}_rad" for n in range(1, 8))]
        tables[way] = {
            (entry.name, stream): entry.table(stream).select(columns).replace_schema_metadata()
            for entry in result
            for stream, columns in zip(("skin", "arm"), names, strict=True)
        }
    skin, arm = _recording(1)
    assert tables["csv"]["t1", "skin"].column("taxel15").to_pylist() == skin["data_15"].tolist()
    assert tables["csv"]["t1", "arm"].column("joint7_rad").to_pylist() == arm["joint7_rad"].tolist()
    for way in tables:
        assert set(tables[way]) == set(tables["csv"])
        for key, table in tables["csv"].items():
            assert tables[way][key].equals(table), f"{way}: {key}"


def test_a_bag_needs_no_layout(lab: Lab) -> None:
    skin, arm = _recording(0)
    writers.ros2(lab.folder / "bags" / "t0", _messages(writers.store(), skin, arm))
    lab.run("ingest rosbag bags -o data/rec")
    (entry,) = tacpipe.open(lab.folder / "data" / "rec")
    assert set(entry.streams) == {"skin", "joint_states"}
    field = entry.table("joint_states").schema.field("t_ns")
    assert field.metadata == {b"unit": b"ns", b"quantity": b"time", b"clock": b"header stamp", b"frame": b"base"}
    assert entry.table("joint_states").column("t_log_ns").to_pylist() == (arm["t_ns"] + 300_000).tolist()


def test_a_layout_may_choose_the_log_time_whatever_the_order_of_the_headers(lab: Lab) -> None:
    types, name = writers.store(), "geometry_msgs/msg/WrenchStamped"
    sent = []
    for number, late_ns in enumerate((0, 30, 20)):
        header = writers.header(types, START_NS - late_ns)
        message = writers.build(types, name, header=header, wrench={"force": {"z": number}})
        sent.append(("/w", name, START_NS + number, message))
    writers.ros2(lab.folder / "bags" / "t0", sent)
    (lab.folder / "l.toml").write_text('[streams.w]\nsource = "/w"\ntime = { column = "t_log_ns", unit = "ns" }')
    lab.run("ingest rosbag bags -o data/header")
    lab.run("ingest rosbag bags --layout l.toml -o data/log")
    result = {}
    for way in ("header", "log"):
        (entry,) = tacpipe.open(lab.folder / "data" / way)
        result[way] = entry.table("w").column("force_z_n").to_pylist()
    assert result == {"header": [1, 2, 0], "log": [0, 1, 2]}


def test_a_guess_of_a_bag_given_back_reads_the_same(lab: Lab) -> None:
    skin, arm = _recording(0)
    writers.ros2(lab.folder / "bags" / "t0", _messages(writers.store(), skin, arm))
    guessed = lab.run("ingest rosbag bags --guess").out
    (lab.folder / "layout.toml").write_text(guessed)
    lab.run("ingest rosbag bags -o data/plain")
    lab.run("ingest rosbag bags --layout layout.toml -o data/guessed")
    assert lab.manifest("data/plain").recordings == lab.manifest("data/guessed").recordings


def test_what_is_not_an_mcap_file_is_refused_in_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    for content in (b"", b"\x89MCAP", b"PK\x03\x04" * 10):
        path.write_bytes(content)
        with pytest.raises(TacpipeError, match=r"a\.mcap"):
            open_bag(path).read(None, None)


def test_a_file_that_tacpipe_exported_comes_back_with_its_names_and_metadata(tmp_path: Path) -> None:
    definition = "std_msgs/Header header\nuint16 force_x\nuint8[] frame\n" + "=" * 80 + "\nMSG: std_msgs/Header\n"
    definition += "builtin_interfaces/Time stamp\nstring frame_id\n" + "=" * 80 + "\nMSG: builtin_interfaces/Time\n"
    definition += "int32 sec\nuint32 nanosec\n"
    columns = [
        {"field": "force_x", "name": "Force X", "about": {"unit": "count", "quantity": "tactile"}},
        {"field": "frame", "name": "frame", "about": {}},
    ]
    local = {"tacpipe": json.dumps({"stream": "skin", "columns": columns, "time": {"unit": "ns", "quantity": "time"}})}
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        writer.add_metadata("tacpipe", {"recording": "a", "attributes": '{"material": "cork", "n": 3}'})
        schema = writer.register_schema("tacpipe_msgs/msg/Skin", "ros2msg", definition.encode())
        channel = writer.register_channel("/skin_x", "cdr", schema, local)
        derived = writer.register_channel("/skin_x/pose", "cdr", schema, {"tacpipe": '{"derived_from": "/skin_x"}'})
        seconds = (START_NS // 10**9).to_bytes(4, "little")
        content = b"\0\1\0\0" + seconds + bytes(4) + b"\1\0\0\0\0\0" + (7).to_bytes(2, "little") + b"\2\0\0\0ab"
        for entry in (channel, derived):
            writer.add_message(entry, START_NS, content, START_NS)
        writer.finish()  # type: ignore[no-untyped-call]
    contents = read(path)
    (stream,) = contents.streams
    assert stream.name == "skin"
    assert stream.table.to_pylist() == [{"t_header_ns": START_NS, "Force X": 7, "frame": b"ab"}]
    assert stream.table.schema.field("Force X").metadata == {b"unit": b"count", b"quantity": b"tactile"}
    assert contents.attributes == {"material": "cork", "n": 3}


def _touch_type() -> tuple[Any, bytes]:
    """Return the class of a message of a lab's own, and the descriptors that describe it."""
    file = descriptor_pb2.FileDescriptorProto(name="lab.proto", package="lab", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    message = file.message_type.add(name="Touch")
    point = message.nested_type.add(name="Point")
    kinds = descriptor_pb2.FieldDescriptorProto
    for number, axis in enumerate("xy", 1):
        point.field.add(name=axis, number=number, type=kinds.TYPE_DOUBLE, label=kinds.LABEL_OPTIONAL)
    fields = [
        ("timestamp", kinds.TYPE_MESSAGE, kinds.LABEL_OPTIONAL, ".google.protobuf.Timestamp"),
        ("count", kinds.TYPE_UINT32, kinds.LABEL_OPTIONAL, ""),
        ("force", kinds.TYPE_FLOAT, kinds.LABEL_REPEATED, ""),
        ("contact", kinds.TYPE_BOOL, kinds.LABEL_OPTIONAL, ""),
        ("data", kinds.TYPE_BYTES, kinds.LABEL_OPTIONAL, ""),
        ("at", kinds.TYPE_MESSAGE, kinds.LABEL_OPTIONAL, ".lab.Touch.Point"),
        ("name", kinds.TYPE_STRING, kinds.LABEL_OPTIONAL, ""),
    ]
    for number, (name, kind, label, type_name) in enumerate(fields, 1):
        message.field.add(name=name, number=number, type=kind, label=label, type_name=type_name or None)
    stamps = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamps)
    described = descriptor_pb2.FileDescriptorSet(file=[stamps, file])
    pool = descriptor_pool.DescriptorPool()
    for entry in described.file:
        pool.Add(entry)
    output = message_factory.GetMessageClass(pool.FindMessageTypeByName("lab.Touch"))
    return output, described.SerializeToString()


def _protobuf(path: Path, contents: list[bytes], schema: bytes) -> Path:
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        channel = writer.register_channel("/touch", "protobuf", writer.register_schema("lab.Touch", "protobuf", schema))
        for step, content in enumerate(contents):
            writer.add_message(channel, START_NS + step, content, START_NS + step)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def test_protobuf_messages_are_read_by_their_descriptors(tmp_path: Path) -> None:
    output, schema = _touch_type()
    contents = []
    for step in range(3):
        message = output(
            count=step, force=[0.1, step], contact=step > 1, data=b"\xff" * step, at={"x": 1.5}, name="tip"
        )
        message.timestamp.FromNanoseconds(START_NS + step - 5)
        contents.append(message.SerializeToString())
    table = only(_protobuf(tmp_path / "a.mcap", contents, schema))
    assert table.column("t_header_ns").to_pylist() == [START_NS - 5, START_NS - 4, START_NS - 3]
    assert table.select(["count", "force_1", "contact", "data", "at_x", "name"]).to_pylist()[2] == {
        "count": 2,
        "force_1": 2.0,
        "contact": True,
        "data": b"\xff\xff",
        "at_x": 1.5,
        "name": "tip",
    }
    assert (table.schema.field("force_0").type, table.schema.field("count").type) == (pa.float32(), pa.uint32())


@pytest.mark.parametrize(("content", "schema"), [(b"\xff\xff", None), (b"", b""), (b"", b"\xff")])
def test_protobuf_that_does_not_fit_its_descriptors_costs_its_topic(
    tmp_path: Path, content: bytes, schema: bytes | None
) -> None:
    provided = _touch_type()[1] if schema is None else schema
    contents = read(_protobuf(tmp_path / "a.mcap", [content], provided))
    assert (list(contents.streams), list(contents.skipped)) == ([], ["/touch"])
    assert "lab.Touch" in contents.skipped["/touch"]
