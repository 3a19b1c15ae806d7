"""Lines of text as the rig file describes them: every number in its place, or no sample."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.cli import sensors
from tacpipe.errors import UsageError
from tacpipe.links.probing import Report, recognise
from tacpipe.recording import rig
from tacpipe.recording.reading import LinkReader
from tacpipe.sensors import lines_guess
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.lines import Lines
from tacpipe.sensors.sensor import Samples
from tests.sensors import serial_lab

ARDUINO = """count,millis,taxel1,taxel2,tilt
0,1000,12,4095,-1.50
1,1010,13,4094,-1.25
2,1020,14,4093,1e-3
"""


def lines(**options: Any) -> Lines:
    sensor = rig.build_sensor("lines", {"rate_hz": 100, **options}, "test")
    assert isinstance(sensor, Lines)
    return sensor


def given_out(sensor: Lines, text: str) -> list[list[Any]]:
    """Return the values of each sample of a text that follows on a line cut off by the start."""
    samples, _ = serial_lab.read(sensor, b"cut off\n" + text.encode())
    blocks = serial_lab.values(samples)
    return [
        [value for block in blocks for value in block[row].tolist()] for row in range(len(blocks[0]) if blocks else 0)
    ]


def causes(sensor: Lines, text: str) -> list[str]:
    _, losses = serial_lab.read(sensor, b"cut off\n" + text.encode())
    return [loss.cause for loss in losses][1:]


TAXELS = [{"name": "taxel{1..3}", "type": "i32"}]


def test_a_boards_lines_by_hand_are_its_samples_with_counter_and_clock() -> None:
    sensor = lines(
        columns=[
            {"name": "count", "type": "u8"},
            {"name": "millis", "type": "u32"},
            {"name": "taxel{1..2}", "type": "u16", "unit": "count"},
            {"name": "tilt", "type": "f64", "unit": "deg", "quantity": "angle"},
        ],
        sequence={"column": "count"},
        clock={"column": "millis", "unit": "ms"},
    )
    samples = sensor.decode([line.encode() for line in ARDUINO.split("\n")[1:-1]])
    assert [block.tolist() for block in samples.values] == [
        [[12, 4095], [13, 4094], [14, 4093]],
        [[-1.5], [-1.25], [1e-3]],
    ]
    assert samples.seq is not None and samples.seq.tolist() == [0, 1, 2]
    assert samples.t_device_ns is not None and samples.t_device_ns.tolist() == [10**9, 1010 * 10**6, 1020 * 10**6]
    assert (sensor.counter, sensor.device_wrap_ns) == (256, (1 << 32) * 10**6)
    fields = {field.name: field.metadata for field in sensor.fields()}
    assert fields["taxel02"] == {b"unit": b"count", b"quantity": b"tactile", b"taxel": b"2"}
    assert fields["tilt"] == {b"unit": b"deg", b"quantity": b"angle"}


def test_columns_without_a_quantity_are_tactile_if_their_name_has_taxel_and_state_otherwise() -> None:
    columns = [{"name": "taxel{1..2}"}, {"name": "joint{1..2}", "unit": "rad"}, {"name": "tilt", "quantity": "angle"}]
    fields = lines(columns=columns).fields()
    assert [field.metadata[b"quantity"].decode() for field in fields] == [*["tactile"] * 2, *["state"] * 2, "angle"]
    assert [b"taxel" in field.metadata for field in fields] == [True, True, False, False, False]


@pytest.mark.parametrize(
    ("pattern", "names", "last"),
    [
        ("taxel{0..1}_{x,y,z}", ["taxel00_x", "taxel00_y", "taxel00_z", "taxel01_x"], {"taxel": "2", "axis": "z"}),
        ("t{1..2}_{1..3}", ["t01_01", "t01_02", "t01_03", "t02_01"], {"taxel": "6", "row": "2", "column": "3"}),
        ("{left,right}_pad{1..2}", ["left_pad01", "left_pad02", "right_pad01"], {"taxel": "2", "axis": "right"}),
        ("v{9..101}", ["v009", "v010"], {"taxel": "93"}),
    ],
)
def test_braces_count_the_columns_and_say_which_taxel_each_is(
    pattern: str, names: list[str], last: dict[str, str]
) -> None:
    fields = lines(columns=[{"name": pattern, "quantity": "tactile"}]).fields()
    assert [field.name for field in fields][: len(names)] == names
    metadata = {name.decode(): value.decode() for name, value in fields[-1].metadata.items()}
    assert {name: metadata[name] for name in metadata if name not in ("unit", "quantity")} == last


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({}, "1,2,3\r\n4,5,-6\r\n"),
        ({}, " 1 ,2,\t3\n4,5,-6\n"),
        ({"separator": ";"}, "1;2;3\n4; 5; -6\n"),
        ({"separator": "\t"}, "1\t2\t3\t\n4\t5\t-6\t\n"),
        ({"separator": " "}, "1 2\t3\n 4  5 -6\n"),
        ({"separator": "|"}, "1|2|3\n+4|5|-6\n"),
        ({"suffix": ","}, "1,2,3,\r\n4,5,-6,\r\n"),
        ({"prefix": "$SKIN,"}, "$SKIN,1,2,3\n$SKIN,4,5,-6\n"),
        ({"comments": ["#", "//"]}, "# boot v1.2\n1,2,3\n\n// n,n,n\n4,5,-6\n"),
        ({"sum": {"kind": "sum8", "mark": ",", "digits": "decimal"}}, "1,2,3,238\n4,5,-6,36\n"),
    ],
)
def test_separators_ends_marks_and_comments_are_those_of_the_rig_file(options: dict[str, Any], text: str) -> None:
    sensor = lines(columns=TAXELS, **options)
    assert given_out(sensor, text) == [[1, 2, 3], [4, 5, -6]]
    assert causes(sensor, text) == []


@pytest.mark.parametrize(
    "line",
    [
        "1,2", "1,2,3,4", "1,2,", "1,,3", "1,2,x", "1,2,3.0", "1,2,0x1f", "1,2,1_0", "1 1,2,3", "1;2;3", "1,2,٣",
        "1,2,nan", "1,2,--3", "1,2,2147483648", "1,2,3 ok", "ets Jun  8 2016 00:22:57", "1,2,3e2", "1,2,\x003",
    ],
)  # fmt: skip
def test_what_is_no_full_line_is_counted_and_never_a_sample(line: str) -> None:
    sensor = lines(columns=TAXELS)
    for before in (2, 20):  # looked at one by one, and many at once
        text = "4,5,6\n" * before + line + "\n4,5,6\n"
        assert given_out(sensor, text) == [[4, 5, 6]] * (before + 1)
        assert causes(sensor, text) == ["garbled"]


@pytest.mark.parametrize(
    "line", ["1.5,inf", "1.5,1e999", "1.5,nan", "1.5,", "1.5,1e39", "1.5,0x1p3", "1.5,1.2.3", "1.5,e5"]
)
def test_a_float_that_is_no_number_is_no_sample(line: str) -> None:
    assert given_out(lines(columns=[{"name": "force{1..2}"}]), line + "\n1.5,-2\n") == [[1.5, -2.0]]


def test_missing_values_are_named_and_become_nan_where_a_float_can_be_one() -> None:
    sensor = lines(columns=[{"name": "n", "type": "u8"}, {"name": "f{1..2}"}], missing=["", "ovf"])
    (first, second), third = given_out(sensor, "1,,2.5\n2,ovf,-1\n,1,1\n3,1,1\n")[:2], given_out(sensor, "3,1,1\n")[0]
    assert (first[0], math.isnan(first[1]), first[2]) == (1, True, 2.5)
    assert (second[0], math.isnan(second[1]), second[2]) == (2, True, -1.0)
    assert third == [3, 1.0, 1.0]
    assert causes(sensor, ",1,1\n3,1,1\n") == ["garbled"]  # a whole number cannot be missing


def test_a_decimal_comma_is_read_and_a_point_is_then_no_number() -> None:
    sensor = lines(columns=[{"name": "f{1..2}", "type": "f64"}], separator=";", decimal=",")
    assert given_out(sensor, "1,5;-0,25\n1.5;2\n3;,5\n") == [[1.5, -0.25], [3.0, 0.5]]


def test_labels_stand_before_their_numbers() -> None:
    sensor = lines(columns=[{"name": "f_{x,y}", "label": "F{x,y}:"}, {"name": "t{1..2}", "label": "T{1..2}="}])
    assert given_out(sensor, "Fx:1.5,Fy:-2,T1=3,T2= 4\nFy:1,Fx:1,T1=3,T2=4\n") == [[1.5, -2.0, 3.0, 4.0]]


def test_the_sum_of_a_published_nmea_sentence_is_right_and_a_flipped_digit_is_seen() -> None:
    columns = [{"name": f"c{place}", "skip": place not in (1, 3)} for place in range(1, 7)]
    sensor = lines(columns=columns, prefix="$GPGLL,", sum={"kind": "xor8", "begin": "$"})
    sentence = "$GPGLL,5057.970,N,00146.110,E,142451,A*27\n"  # Example from the description of NMEA 0183.
    assert given_out(sensor, sentence) == [[np.float32(5057.970), np.float32(146.110)]]
    assert given_out(sensor, sentence.replace("5057", "5056")) == []


def test_lost_lines_are_counted_by_their_counter_and_garbage_costs_no_more() -> None:
    sensor = lines(columns=[{"name": "n", "type": "u8"}, {"name": "taxel", "type": "u16"}], sequence={"column": "n"})
    reading = LinkReader(sensor)
    text = "".join(f"{row % 256},{row}\n" for row in range(300) if row not in (100, 255, 256)).replace(
        "\n50,50", "\n5#0,50"
    )
    batches = [reading.feed(Chunks.from_pairs([(10**7, b"x\n" + text.encode())])), reading.finish()]
    assert sum(map(len, batches)) == 296
    assert reading.lost == 4
    assert sorted({event.cause for batch in batches for event in batch.events}) == ["garbled", "link", "start"]


@settings(deadline=None, max_examples=100)
@given(
    st.lists(
        st.lists(
            st.one_of(
                st.integers(-(2**40), 2**40).map(str),
                st.floats().map(repr),
                st.sampled_from(["", "+1", "1_0", "x", ".5", "5."]),
            ),
            min_size=1,
            max_size=4,
        ),
        min_size=9,
        max_size=30,
    ),
    st.sampled_from([",", ";", " ", "\t"]),
)
def test_lines_read_together_are_what_each_is_by_itself(rows: list[list[str]], separator: str) -> None:
    sensor = lines(
        columns=[{"name": "a", "type": "i32"}, {"name": "b", "type": "f64"}], separator=separator, missing=["nan"]
    )
    texts = [separator.join(words).strip().encode() for words in rows]
    singly = [sensor.decode([text]) for text in texts if sensor._is_frame(text)]
    text = b"x\n" + b"".join(line + b"\n" for line in texts)

    runs, losses = sensor.framer().feed(Chunks.from_pairs([(0, text)]))

    joint_batches = [sensor.decode(run.frames) for run in runs]
    assert [len(batch) for batch in joint_batches] == ([sum(map(len, singly))] if singly else [])
    expected = [np.concatenate(blocks) for blocks in zip(*(batch.values for batch in singly), strict=True)]
    assert all(
        np.array_equal(block, expected_block, equal_nan=block.dtype.kind == "f")
        for batch in joint_batches
        for block, expected_block in zip(batch.values, expected, strict=True)
    )
    assert len(losses) == 1 + len(texts) - len(singly)


@pytest.mark.parametrize(
    ("options", "names"),
    [
        ({"columns": []}, "column"),
        ({"columns": [{"name": "A b"}]}, "A b"),
        ({"columns": [{"name": "a"}, {"name": "a"}]}, "named a"),
        ({"columns": [{"name": "a{3..1}"}]}, "{1..3}"),
        ({"columns": [{"name": "a{1..99999}"}]}, "4096"),
        ({"columns": [{"name": "a{1..2}", "label": "x{1..3}"}]}, "x{1..3}"),
        ({"columns": TAXELS, "separator": "::"}, "::"),
        ({"columns": TAXELS, "separator": "-"}, "-"),
        ({"columns": TAXELS, "decimal": ","}, "separator"),
        ({"columns": TAXELS, "sequence": {"column": "n"}}, "n"),
        ({"columns": TAXELS, "sequence": {"column": "taxel01"}}, "i32"),
        ({"columns": [*TAXELS, {"name": "n", "type": "u8"}], "sequence": {"column": "n", "modulus": 300}}, "256"),
        ({"columns": TAXELS, "missing": ["99"]}, "missing"),
        ({"columns": TAXELS, "comments": [" "]}, "comment"),
        ({"columns": TAXELS, "sum": {"kind": "xor8", "mark": ""}}, "mark"),
        ({"columns": TAXELS, "rate_hz": 0}, "rate_hz"),
    ],
)
def test_what_cannot_be_is_refused_with_its_value(options: dict[str, Any], names: str) -> None:
    with pytest.raises(UsageError) as error:
        lines(**options)
    assert names in str(error.value)


BOARDS: dict[str, dict[str, Any]] = {
    "an Arduino": {"columns": [{"name": "taxel{1..16}", "type": "i32", "unit": "count"}]},
    "a single number": {"columns": [{"name": "taxel{1..1}", "type": "i32", "unit": "count"}]},
    "spaces": {"columns": [{"name": "taxel{1..5}"}], "separator": " "},
    "semicolons and decimal commas": {"columns": [{"name": "taxel{1..3}"}], "separator": ";", "decimal": ","},
    "NMEA": {
        "columns": [{"name": "taxel{1..4}", "type": "i32", "unit": "count"}],
        "prefix": "$SKIN,",
        "sum": {"kind": "xor8", "begin": "$"},
    },
    "a dollar and a sum": {
        "columns": [{"name": "taxel{1..4}"}],
        "prefix": "$",
        "sum": {"kind": "xor8", "begin": "$"},
    },
    "a CRC": {
        "columns": [{"name": "taxel{1..4}", "type": "i32", "unit": "count"}],
        "sum": {"kind": "crc16-modbus", "mark": ","},
    },
    "counter and clock": {
        "columns": [
            {"name": "count", "type": "u32"},
            {"name": "device_time", "type": "u32"},
            {"name": "taxel{1..2}", "type": "i32", "unit": "count"},
        ],
        "sequence": {"column": "count"},
        "clock": {"column": "device_time", "unit": "us"},
    },
    "labels": {"columns": [{"name": "fx", "label": "Fx:"}, {"name": "fy", "label": "Fy:"}]},
    "a trailing comma": {"columns": [{"name": "taxel{1..3}"}], "suffix": ","},
}  # fmt: skip


@pytest.mark.parametrize("board", BOARDS)
def test_a_guess_finds_the_options_that_wrote_the_lines(board: str) -> None:
    options = {"rate_hz": 100.0, **BOARDS[board]}
    sensor = lines(**BOARDS[board])
    rng = np.random.default_rng(4)
    kinds = [field.type.to_pandas_dtype() for field in sensor.fields()]
    values = tuple(
        np.column_stack([(rng.normal(0, 500, 200)).astype(kind) for _ in range(kinds.count(kind))])
        for kind in dict.fromkeys(kinds)
    )
    count = np.arange(200)
    encoded = sensor.encode(Samples(values, seq=count, t_device_ns=count * 10**7))
    data = Chunks.from_pairs([(int(row) * 10**7, line + b"\r\n") for row, line in zip(count, encoded, strict=True)])

    (guessed,) = lines_guess.guess_options(data)

    assert guessed == options | {"columns": [{"type": "f32", **column} for column in options["columns"]]}
    assert lines(**guessed) == sensor


def test_a_header_that_the_board_prints_names_the_columns() -> None:
    text = "boot\n# n, Fx (N), fy\n" + "".join(f"{row},{row / 7:.3f},{row / 3:.2f}\n" for row in range(40))
    (guessed,) = lines_guess.guess_options(
        Chunks.from_pairs([(row, part.encode() + b"\n") for row, part in enumerate(text.split("\n"))])
    )
    columns: Any = guessed["columns"]
    assert [column["name"] for column in columns] == ["n", "fx_n", "fy"]
    assert guessed["comments"] == ["#"]


@pytest.mark.parametrize(
    "text", [b"", b"hello\nworld\n" * 20, bytes(range(256)) * 20, b"<a x='1'/>\n" * 50, b'{"a": 1}\n' * 50]
)
def test_what_is_no_lines_of_numbers_gives_no_guess(text: bytes) -> None:
    assert lines_guess.guess_options(Chunks.from_pairs([(0, text)] if text else [])) == []


def test_what_a_probe_prints_is_a_rig_file_that_reads_the_board_and_says_what_is_a_guess() -> None:
    board = lines(**BOARDS["counter and clock"], prefix="$SKIN,", sum={"kind": "xor8", "begin": "$"}, comments=["#"])
    count = np.arange(200)
    counts = np.random.default_rng(1).integers(-500, 500, (200, 2)).astype(np.int32)
    encoded = [b"# boot of the board", *board.encode(Samples((counts,), seq=count, t_device_ns=count * 10**7))]
    data = Chunks.from_pairs([(row * 10**7, line + b"\r\n") for row, line in enumerate(encoded)])

    text = sensors._text(Report("serial:/dev/ttyACM0", recognise(data, "serial"), 9600, heard=len(data.data)))

    stanza = text[text.index("[[stream]]") :]
    stream = rig.parse(stanza).streams["lines"]
    assert stream.sensor == dataclasses.replace(board, baud=9600)
    assert [line.split("=")[0].strip() for line in stanza.split("\n") if "# a guess" in line] == ["sequence", "clock"]
