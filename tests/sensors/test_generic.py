"""A board that only the rig file describes is read correctly, and a wrong description is reported in a sentence."""

import struct
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tacpipe.errors import UsageError
from tacpipe.recording import rig
from tacpipe.sensors import layout
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.generic import Generic
from tacpipe.sensors.optoforce import OptoForce
from tacpipe.sensors.sensor import Samples
from tacpipe.testing.dialogues import hold_dialogue
from tests.emulation.devices import device_for
from tests.sensors.serial_lab import read, rows_of, stream, streams, values

BOARD = """
[[stream]]
name = "skin"
sensor = "generic"
transport = "serial:/dev/ttyACM0"

[stream.options]
rate_hz = 500
marker = "AA 55"
numbers = [
    { name = "count", type = "u16" },
    { name = "micros", type = "u32" },
    { name = "kind", type = "u8", equals = 7 },
    { name = "taxel", type = "i16", count = 2, axes = "xyz", unit = "count" },
    { name = "spare", type = "u8", count = 3, skip = true },
    { name = "load", type = "f32", order = "big", unit = "N", quantity = "force" },
    { name = "check", type = "u8" },
]
sequence = { number = "count", modulus = 1000 }
clock = { number = "micros", unit = "us" }
sum = { kind = "sum8", number = "check", begin = 2 }
"""
DAQ = {  # An OptoForce frame, three axes.
    "rate_hz": 1000,
    "marker": "AA 07 08 0A",
    "order": "big",
    "numbers": [
        {"name": "count", "type": "u16"},
        {"name": "status", "type": "u16", "quantity": "status"},
        {"name": "force", "type": "i16", "axes": "xyz", "unit": "count", "quantity": "force"},
        {"name": "check", "type": "u16"},
    ],
    "sequence": {"number": "count"},
    "sum": {"kind": "sum16", "number": "check"},
}
TYPES = ("u8", "i8", "u16", "i16", "u24", "i24", "u32", "i32", "u64", "i64", "f32", "f64")


def board(**options: Any) -> Generic:
    sensor = rig.build_sensor("generic", {"rate_hz": 100, "marker": "AA", **options}, "rig")
    assert isinstance(sensor, Generic)
    return sensor


def by_hand(count: int, micros: int, taxels: list[int], load: float) -> bytes:
    body = struct.pack("<HIB6h3x", count, micros, 7, *taxels) + struct.pack(">f", load)
    return b"\xaa\x55" + body + bytes([sum(body) & 0xFF])


def test_a_board_of_a_rig_file_is_read() -> None:
    sensor = rig.parse(BOARD).streams["skin"].sensor
    sent = by_hand(998, 5_000_000, [1, -2, 3, -4, 5, -32768], 0.5) + by_hand(999, 5_002_000, [0] * 6, -1.5)
    batches, losses = read(sensor, sent + by_hand(0, 5_004_000, [0] * 6, 0), (11,))

    taxels, load = values(batches)
    assert taxels[:2].tolist() == [[1, -2, 3, -4, 5, -32768], [0] * 6] and load[:2, 0].tolist() == [0.5, -1.5]
    assert not losses and sensor.counter == 1000
    assert [int(n) for batch in batches for n in batch.seq] == [998, 999, 0]  # type: ignore[union-attr]
    assert [int(t) for batch in batches for t in batch.t_device_ns] == [5_000_000_000, 5_002_000_000, 5_004_000_000]  # type: ignore[union-attr]
    fields = sensor.fields()
    assert [field.name for field in fields] == [f"taxel0{n}_{axis}" for n in (1, 2) for axis in "xyz"] + ["load"]
    assert [str(field.type) for field in fields] == ["int16"] * 6 + ["float"]
    assert fields[4].metadata == {b"unit": b"count", b"quantity": b"tactile", b"taxel": b"2", b"axis": b"y"}
    assert fields[6].metadata == {b"unit": b"N", b"quantity": b"force"}


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 1000), sizes=st.lists(st.integers(5, 100), min_size=1, max_size=4))
def test_a_description_of_a_daq_reads_what_its_driver_reads(seed: int, sizes: list[int]) -> None:
    rng = np.random.default_rng(seed)
    status = rng.integers(0, 1 << 16, (20, 1), dtype=np.uint16)
    axes = rng.integers(-(1 << 15), 1 << 15, (20, 3), dtype=np.int16)
    driver, described = OptoForce(axes=3), rig.build_sensor("generic", DAQ, "rig")
    samples = Samples((status, axes), seq=np.arange(65_530, 65_550) % (1 << 16))
    data = bytearray(stream(driver.encode(samples)))
    assert stream(described.encode(samples)) == data
    data[100] ^= 4
    assert rows_of(read(described, bytes(data), sizes)[0]) == rows_of(read(driver, bytes(data), sizes)[0])


def test_24_bits_have_their_sign_in_either_order() -> None:
    sensor = board(
        numbers=[
            {"name": "a", "type": "i24"},
            {"name": "b", "type": "i24", "order": "big"},
            {"name": "c", "type": "u24", "count": 2},
        ]
    )
    frame = bytes.fromhex("AA FE FF FF 80 00 01 FF FF FF 01 00 00")
    samples = sensor.decode(np.frombuffer(frame, np.uint8)[None])
    assert [block.tolist() for block in samples.values] == [[[-2, -(1 << 23) + 1]], [[(1 << 24) - 1, 1]]]
    assert sensor.encode(samples).tobytes() == frame


NUMBERS = st.lists(
    st.tuples(
        st.sampled_from(TYPES), st.integers(1, 3), st.sampled_from(["", "xy"]), st.sampled_from([None, "little", "big"])
    ),
    min_size=1,
    max_size=6,
)


@settings(deadline=None, max_examples=50)
@given(
    numbers=NUMBERS,
    order=st.sampled_from(["little", "big"]),
    kind=st.sampled_from([None, *layout.SUMS]),
    tail=st.sampled_from(["", "0D 0A"]),
    has_length=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_decode_undoes_encode_whatever_is_described(
    numbers: list[tuple[str, int, str, str | None]],
    order: str,
    kind: str | None,
    tail: str,
    has_length: bool,
    seed: int,
) -> None:
    tables: list[dict[str, Any]] = [{"name": "n", "type": "u8"}, {"name": "ticks", "type": "u32"}]
    for number, (type_, count, axes, column_order) in enumerate(numbers):
        tables.append(
            {
                "name": f"c{number}_",
                "type": type_,
                "count": count,
                "axes": axes,
                **({"order": column_order} if column_order else {}),
            }
        )
    options: dict[str, Any] = {"sequence": {"number": "n"}, "clock": {"number": "ticks", "unit": "ms"}}
    if has_length:
        tables.insert(0, {"name": "size", "type": "u16"})
        options["length"] = {"number": "size", "plus": 3}
    if kind:
        tables.append({"name": "check", "type": f"u{8 * layout.SUMS[kind][1]}"})
        options["sum"] = {"kind": kind, "number": "check"}
    sensor = board(numbers=tables, order=order, tail=tail, **options)
    rng = np.random.default_rng(seed)
    blocks: list[list[Any]] = []
    for field in sensor.fields():
        if not blocks or blocks[-1][0] != field.type:
            blocks.append([field.type, 0])
        blocks[-1][1] += 1
    values_by_block = []
    for type_of, width in blocks:
        dtype = np.dtype(type_of.to_pandas_dtype())
        limits = (-100, 100) if dtype.kind in "if" else (0, 100)
        values_by_block.append(rng.integers(*limits, (5, width)).astype(dtype))
    samples = Samples(tuple(values_by_block), seq=np.arange(254, 259) % 256, t_device_ns=np.arange(5) * 1_000_000)

    frames = sensor.encode(samples)
    decoded = sensor.decode(frames)

    assert frames.shape == (5, sensor.size)
    assert all(
        np.array_equal(ours, theirs) and ours.dtype == theirs.dtype
        for ours, theirs in zip(decoded.values, values_by_block, strict=True)
    )
    assert decoded.seq is not None and decoded.seq.tolist() == [254, 255, 0, 1, 2]
    assert decoded.t_device_ns is not None and decoded.t_device_ns.tolist() == (np.arange(5) * 1_000_000).tolist()
    assume(kind is not None and layout.SUMS[kind][1] > 1)
    assert rows_of(read(sensor, frames.tobytes())[0]) == rows_of([samples])


def test_frames_of_another_size_hold_no_sample_and_disturb_nothing() -> None:
    sensor = board(
        numbers=[
            {"name": "size", "type": "u8"},
            {"name": "taxel", "type": "u8", "count": 4},
            {"name": "check", "type": "u32"},
        ],
        length={"number": "size", "plus": 2},
        sum={"kind": "crc32", "number": "check"},
    )

    def sent(data: bytes) -> bytes:
        body = b"\xaa" + bytes([len(data) + 4]) + data
        return body + zlib.crc32(body).to_bytes(4, "little")

    frames = [sent(b"abcd"), sent(b"a longer message"), sent(b"efgh"), sent(b"."), sent(b"ijkl")]
    batches, losses = read(sensor, b"".join(frames), (9,))
    assert rows_of(batches) == [b"abcd", b"efgh", b"ijkl"] and not losses


def test_marks_in_a_payload_that_holds_still_give_nothing_until_it_moves_though_a_constant_stands_behind_them() -> None:
    sensor = board(
        marker="AA 55", numbers=[{"name": "id", "type": "u8", "equals": 3}, {"name": "v", "type": "u8", "count": 7}]
    )
    repeating = bytes.fromhex("AA 55 03 09 08 AA 55 03 01 02")
    moving = [bytes.fromhex("AA 55 03") + bytes([number]) * 7 for number in range(10)]
    framer = sensor.framer()
    assert framer.feed(Chunks.from_pairs([(0, repeating[5:] + 20 * repeating)])) == ([], [])
    runs, _ = framer.feed(Chunks.from_pairs([(1, b"".join(moving))]))
    assert stream(frame for run in runs for frame in run.frames) == 20 * repeating + b"".join(moving[:-1])


def test_each_packet_is_a_frame_where_the_link_has_packets() -> None:
    sensor = board(
        marker="", packets=True, numbers=[{"name": "id", "type": "u8", "equals": 3}, {"name": "v", "type": "u16"}]
    )
    runs, losses = sensor.framer().feed(
        Chunks.from_pairs([(1, b"\x03\x01\x02"), (2, b"\x04\x01\x02"), (3, b"\x03\x01")])
    )
    assert [sensor.decode(run.frames).values[0].tolist() for run in runs] == [[[0x0201]]]
    assert [(loss.t_ns, loss.cause) for loss in losses] == [(2, "malformed"), (3, "malformed")]


def test_a_board_is_started_and_stopped_where_the_file_says_how() -> None:
    sensor = board(numbers=[{"name": "v", "type": "u16"}], start="67 6F 0A", stop="0A 6F 67")
    device = device_for(sensor)
    assert not streams(device)
    assert hold_dialogue(sensor.opening({}), device).sent == [b"go\n"] and streams(device)
    device.hear(sensor.closing()[:2])
    device.hear(sensor.closing()[2:])
    assert not streams(device)
    silent = board(numbers=[{"name": "v", "type": "u16"}])
    assert (
        not hold_dialogue(silent.opening({}), device_for(silent)).sent
        and streams(device_for(silent))
        and not silent.closing()
    )


V = {"name": "v", "type": "u16"}
N = {"name": "n", "type": "u8"}


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"numbers": [V], "marker": "AAB"}, r"marker is 'AAB'; it must be bytes in hexadecimal, such as \"AA 55\"\."),
        ({"numbers": [V], "marker": ""}, "give marker or tail"),
        ({"numbers": []}, "no number is a channel; list the measured values in numbers"),
        ({"numbers": [N], "sequence": {"number": "n"}}, "no number is a channel"),
        ({"numbers": [{"name": "v", "type": "u12"}]}, "rig, numbers 1: type is 'u12'; it must be one of u8, i8"),
        ({"numbers": [V, {"type": "u8"}]}, "rig, numbers 2: key name must be given"),
        (
            {"numbers": [V, {"name": "x", "kind": "u8"}]},
            "rig, numbers 2: there is no key kind; there are name, type, count",
        ),
        ({"numbers": {"name": "v"}}, "rig: numbers is .*; it must be a list, each item a table of name, type"),
        ({"numbers": [V, V]}, "two numbers are named v; names must be unique"),
        (
            {"numbers": [{**V, "count": 2}, {"name": "v01", "type": "u8"}]},
            "two channels are named v01; give the numbers other",
        ),
        ({"numbers": [{**V, "name": "V 1"}]}, "'V 1' is not a valid name; use lower-case letters, digits and _"),
        ({"numbers": [{**V, "count": 0}]}, "the number v has count = 0; it must be between 1 and 4096"),
        ({"numbers": [{**V, "axes": "xx"}]}, 'the number v has axes = "xx"; it must be unique letters, such as "xyz"'),
        ({"numbers": [V, {**N, "equals": 300}]}, "number n has equals = 300, which its type u8 cannot represent"),
        (
            {"numbers": [V, {"name": "f", "type": "f32", "equals": 1}]},
            "f has equals and type f32; equals needs an integer type",
        ),
        (
            {"numbers": [V], "sequence": {"number": "n"}},
            "sequence refers to the number 'n', which does not exist; there are v",
        ),
        (
            {"numbers": [V, {**N, "count": 2}], "sequence": {"number": "n"}},
            "the number n, which has 2 elements; it must have one",
        ),
        ({"numbers": [V, {**N, "type": "i8"}], "sequence": {"number": "n"}}, "n of type i8; it must be unsigned"),
        (
            {"numbers": [V, {**N, "equals": 1}], "clock": {"number": "n", "unit": "s"}},
            "n, which has equals = 1; remove one",
        ),
        (
            {"numbers": [V, N], "sequence": {"number": "n", "modulus": 500}},
            "modulus = 500; its number is u8, so it must be betw",
        ),
        ({"numbers": [V, N], "clock": {"number": "n"}}, "rig, clock: key unit must be given"),
        (
            {"numbers": [V, N], "clock": {"number": "n", "unit": "min"}},
            "rig, clock: unit is 'min'; it must be one of ns, us",
        ),
        (
            {"numbers": [V, N], "clock": {"number": "n", "unit": "s"}, "sequence": {"number": "n"}},
            r"\bn\b",
        ),
        (
            {"numbers": [V, N], "sum": {"kind": "md5", "number": "n"}},
            "sum.*'md5'.*sum8, lrc",
        ),
        (
            {"numbers": [V, N], "sum": {"kind": "sum16", "number": "n"}},
            r"\b16\b.*\bn\b.*u8.*u16",
        ),
        (
            {"numbers": [N, V], "sum": {"kind": "sum8", "number": "n", "begin": 0, "end": 4}},
            r"byte 1\b",
        ),
        (
            {"numbers": [N, V], "sum": {"kind": "sum8", "number": "n", "begin": 2, "end": 9}},
            r"\b2\b.*\b9\b.*\b4\b",
        ),
        (
            {"numbers": [N, V], "length": {"number": "n", "plus": 9}},
            r"length.*-5.*\b4\b",
        ),
        ({"numbers": [{**V, "count": 4000}]}, r"\b8001\b.*\b4096\b"),
        ({"numbers": [V], "rate_hz": 0}, r"rate_hz.*\b0\b"),
        ({"numbers": [V], "rate": 1}, r"\brate\b.*rate_hz, numbers"),
    ],
)
def test_what_cannot_be_is_refused_with_a_sentence(options: Mapping[str, object], sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence):
        board(**options)


def test_rate_and_numbers_must_be_given() -> None:
    with pytest.raises(UsageError, match="rate_hz"):
        rig.build_sensor("generic", {}, "rig")
