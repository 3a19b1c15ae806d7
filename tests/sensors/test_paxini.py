"""Pushed frames of a Paxini board are read as paxini-sdk reads them, and its dialogue works amid an old stream."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from paxini_sdk import protocol, registers, sensor_registry
from paxini_sdk.boards.high_speed import AutoPushConfig, AutoPushFrame, HighSpeedHandBoard

from tacpipe.errors import DeviceError, UsageError
from tacpipe.sensors.paxini import REPLY, SLOTS, VARIANTS, Paxini, find_push_reply, message, write
from tacpipe.sensors.paxini import read as asked
from tacpipe.sensors.sensor import Samples
from tacpipe.testing.dialogues import hold_dialogue
from tests.emulation.devices import device_for
from tests.sensors.serial_lab import read, rows_of, served, stream, streams

HAND = Paxini(
    modules=("thumb_tip", "index_tip", "palm1"), variants=("DP-S2015-Elite", "DP-S1813-Elite", "MC-M2020-Elite")
)
DONE = b"\xaa\x56\x00\x01\x00"  # the reply to the order to push, before its error code
DATA = pytest.mark.parametrize("data", ["both", "resultant", "distributed"])


def random_samples(sensor: Paxini, count: int, seed: int) -> Samples:
    rng = np.random.default_rng(seed)
    kinds = [str(field.type) for field in sensor.fields()]
    signed, unsigned = kinds.count("int8"), kinds.count("uint8") - 1
    return Samples(
        (
            np.zeros((count, 1), dtype=np.uint8),
            rng.integers(-128, 128, (count, signed), dtype=np.int8),
            rng.integers(0, 256, (count, unsigned), dtype=np.uint8),
        )
    )


def test_a_frame_by_hand_is_read() -> None:
    sensor = Paxini(modules=("palm3",), variants=("MC-M2020-Elite",))
    payload = bytes([0xFF, 0, 2, 0, 250, 0]) + bytes([0x80, 1, 200]) + bytes(24)
    frame = b"\xaa\x56\x00" + (len(payload) + 1).to_bytes(2, "little") + b"\x07" + payload
    frame += bytes([protocol.lrc(frame)])
    batches, losses = read(sensor, 2 * frame)
    names = [field.name for field in sensor.fields()]
    row = np.concatenate([block[0].astype(int) for block in batches[0].values]).tolist()
    assert dict(zip(names, row, strict=True)) | {"status": 7} == {
        **dict.fromkeys(names, 0),
        "status": 7,
        "palm3_force_x": -1,
        "palm3_force_y": 2,
        "palm3_force_z": 250,
        "palm3_taxel01_x": -128,
        "palm3_taxel01_y": 1,
        "palm3_taxel01_z": 200,
    }
    assert row[0] == 7 and not losses


def test_modules_and_variants_are_those_of_the_vendor() -> None:
    assert [name.lower().replace("-", "_").replace("palm_", "palm") for name in registers.MODULE_NAMES] == list(SLOTS)
    vendors = {
        model.sensor_model.removeprefix("PX6AX-GEN3-"): model.n_points for model in sensor_registry.list_sensors()
    }
    assert vendors == VARIANTS


@DATA
@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 1000), sizes=st.lists(st.integers(40, 300), min_size=1, max_size=4))
def test_what_was_encoded_is_decoded_however_it_is_cut(data: Any, seed: int, sizes: list[int]) -> None:
    sensor = Paxini(modules=HAND.modules, variants=HAND.variants, data=data)
    samples = random_samples(sensor, 10, seed)
    batches, losses = read(sensor, stream(sensor.encode(samples)), sizes)
    assert rows_of(batches) == rows_of([samples]) and not losses


@DATA
def test_the_vendor_reads_the_same_values(data: Any) -> None:
    sensor = Paxini(modules=HAND.modules, variants=HAND.variants, data=data)
    samples = random_samples(sensor, 20, 1)
    names = [field.name for field in sensor.fields()]
    slots = {SLOTS.index(module): count for module, count in sensor.points.items()}
    config = AutoPushConfig(list(slots), data != "distributed", data != "resultant", slots)
    for row, frame in enumerate(sensor.encode(samples)):
        parsed = protocol.parse_auto_push(frame.tobytes())
        find_push_reply = AutoPushFrame(config, parsed.error_code, parsed.valid_data, parsed.raw)
        ours = dict(
            zip(names, np.concatenate([block[row].astype(int) for block in samples.values]).tolist(), strict=True)
        )
        theirs = {"status": parsed.error_code}
        for name, force in find_push_reply.resultant_forces.items():
            slot = SLOTS[registers.MODULE_NAMES.index(name)]
            theirs |= {f"{slot}_force_{axis}": value for axis, value in zip("xyz", force, strict=True)}
        for name, points in find_push_reply.distributed_forces.items():
            slot = SLOTS[registers.MODULE_NAMES.index(name)]
            for number, force in enumerate(points, start=1):
                theirs |= {f"{slot}_taxel{number:02d}_{axis}": value for axis, value in zip("xyz", force, strict=True)}
        assert ours == theirs


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 1000), bit=st.integers(0, 2000))
def test_after_a_flipped_bit_nothing_is_read_that_was_not_sent(seed: int, bit: int) -> None:
    samples = random_samples(HAND, 10, seed)
    data = bytearray(stream(HAND.encode(samples)))
    data[bit // 8] ^= 1 << bit % 8
    batches, _ = read(HAND, bytes(data))
    assert set(rows_of(batches)) < set(rows_of([samples]))


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 1000), size=st.integers(30, 500))
def test_the_board_is_opened_though_an_earlier_session_still_streams(seed: int, size: int) -> None:
    device = device_for(HAND)
    stale = stream(HAND.encode(random_samples(HAND, 3, seed)))[5:]
    stale += b"\xaa\x55\x00\x03\x10\x00\x04\x00"  # These bytes begin as a reply does.
    messages = hold_dialogue(HAND.opening({}), device, between=stale, piece_bytes=size).sent
    assert [sent_bytes.hex(" ") for sent_bytes in messages] == [
        "55 aa 00 10 17 00 01 00 00 d9",
        "55 aa 00 03 00 00 0f 00 ef",
        "55 aa 00 03 10 00 04 00 ea",
        "55 aa 00 03 30 00 38 00 96",
        "55 aa 00 10 16 00 01 00 03 d7",
        "55 aa 00 10 17 00 01 00 01 d8",
    ]
    assert streams(device)
    device.hear(HAND.closing())
    assert not streams(device)


def test_requests_are_those_of_the_vendor() -> None:
    assert asked(0x30, 56) == protocol.build_simple_request(protocol.FUNC_READ_SIMPLE, 0x30, data_len=56)
    assert write(0x17, b"\x01") == protocol.build_simple_request(protocol.FUNC_WRITE_SIMPLE, 0x17, data=b"\x01")
    (sent_bytes,) = hold_dialogue(HAND.taring(), device_for(HAND)).sent
    assert sent_bytes == bytes.fromhex("55AA00170200010001E6")


def test_other_modules_than_in_the_rig_file_are_told_with_what_to_write() -> None:
    sensor = Paxini(modules=("index_tip",), variants=("DP-S2015-Elite",))
    with pytest.raises(DeviceError) as caught:
        hold_dialogue(sensor.opening({}), device_for(HAND))
    assert str(caught.value) == (
        "The board (PX-HS V1.0.0) has thumb_tip of 52 points, index_tip of 31 points, palm1 of 9 points; the rig file "
        "declares "
        'index_tip of 52 points. Correct the rig file: modules = ["thumb_tip", "index_tip", "palm1"], '
        'variants = ["DP-S2015-Elite", "DP-S1813-Elite", "MC-M2020-Elite"].'
    )


def test_a_refusal_and_a_write_without_data_are_understood() -> None:
    opening = HAND.opening({})
    device = device_for(HAND)
    asks = [next(opening)]
    while asks[-1].send[3:6] != b"\x10\x16\x00":
        asks.append(opening.send(b"".join(device.hear(asks[-1].send))))
    with pytest.raises(DeviceError, match='= "both": error 1'):
        opening.send(message(0x10, 0x16, b"\x01", REPLY))
    taring = HAND.taring()
    ask = next(taring)
    with pytest.raises(DeviceError, match="error 3"):
        taring.send(message(0x17, 0x02, b"\x03", REPLY))
    with pytest.raises(DeviceError, match=r"0x17.*0x0002"):
        ask.find_reply(message(0x97, 0x02, b"\x03", REPLY))
    head = b"\xaa\x55\x00\x17\x02\x00\x01\x00"
    assert ask.find_reply(head + bytes([protocol.lrc(head)])) == (0, 9)


def test_the_first_forces_that_are_pushed_are_looked_at_and_stay_a_sample() -> None:
    frame = stream(HAND.encode(random_samples(HAND, 1, 6)))
    success, error = (head + bytes([protocol.lrc(head)]) for head in (DONE + b"\x00", DONE + b"\x05"))
    assert find_push_reply(frame[:-1]) == 0
    assert find_push_reply(frame) == (0, 0)
    assert find_push_reply(frame[9:] + success + frame) == (len(frame) - 9, len(frame) - 9 + len(success))
    with pytest.raises(DeviceError, match="error 5"):
        find_push_reply(error)


@pytest.mark.rig
def test_the_vendors_client_is_served() -> None:
    samples, device = random_samples(HAND, 100, 3), device_for(HAND)
    frames = HAND.encode(samples)
    device.streaming = True  # an earlier session left it so
    with served(device, lambda number: bytes(frames[number % 100]), 0.011) as port, HighSpeedHandBoard(port) as board:
        board.disable_auto_push()
        assert board.read_version() == "PX-HS V1.0.0"
        config = board.read_auto_push_config()
        find_push_reply = list(board.stream_auto_push(max_frames=5, config=config))
        board.calibrate()
    assert {SLOTS[slot]: count for slot, count in config.point_counts.items()} == HAND.points
    sent = {frame.tobytes() for frame in frames}
    assert len(find_push_reply) == 5 and all(frame.raw in sent for frame in find_push_reply)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"modules": ("toe",)}, "modules.*'toe'.*thumb_proximal"),
        (
            {"modules": ("index_tip", "thumb_tip")},
            "modules.*index_tip, thumb_tip.*thumb_prox",
        ),
        ({"modules": ()}, "modules"),
        ({"modules": ("palm1", "palm2", "palm3"), "variants": ("MC-M2020-Elite",) * 2}, r"\b2\b.*\b3\b"),
        ({"variants": ("DP",)}, "variants.*'DP'.*MC-M2020-Elite"),
    ],
)
def test_what_cannot_be_is_refused_with_a_sentence(options: dict[str, object], sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence):
        Paxini(**options)  # type: ignore[arg-type]
