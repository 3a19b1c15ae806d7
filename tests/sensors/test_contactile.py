"""PTS frames are read through their own tables, whatever these look like, and those of the last session are thrown away."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import DeviceError, UsageError
from tacpipe.sensors import pts
from tacpipe.sensors.contactile import Contactile
from tacpipe.sensors.encoding import split_frames
from tacpipe.sensors.framing import Chunks, FrameRun
from tacpipe.sensors.sensor import Samples
from tacpipe.testing.dialogues import hold_dialogue
from tacpipe.testing.frames import are_equal, decode_runs, feed_framer
from tests.emulation.devices import device_for
from tests.sensors import made

ONE = Contactile(sensors=1, pillars=1)
BY_HAND = bytes.fromhex(
    "55667788"
    "02 0100 0D00 0300 1900 0400 3B00"  # offsets of 2 bytes: hub at 13, pillars at 25, sensors at 59
    "01000000 40420F0000000000"  # packet 1 at 1 s
    "0100 0400 0100 0400 0200 0000803F 00000040 00004040 00008040 0000A040 0000C040"  # one sensor, one pillar: 1 to 6
    "0100 0400 0200 0000803F 00000040 00004040 000080BF 000000C0 000040C0"  # 1 2 3 N, -1 -2 -3 N mm
    "AD09"  # the sum of all bytes of the body before
    "AABBCCDD".replace(" ", "")
)


def table(entries: list[bytes], width: int, base: int) -> bytes:
    """Return a nested table of entries, whose offsets are counted from ``base`` bytes before it."""
    place, offsets = 2 + width * len(entries), b""
    for entry in entries:
        offsets += (base + place).to_bytes(width, "little")
        place += len(entry)
    return struct.pack("<H", len(entries)) + offsets + b"".join(entries)


def frame(
    values: list[list[list[float]]], wholes: list[list[float]], *, width: int, absolute: bool, padding: int
) -> bytes:
    """Return a frame from values (sensor, pillar, 6) and (sensor, 6), built straight from the protocol's description."""
    first = 1 + 4 * (2 + width) + padding
    hub = struct.pack("<IQ", 77, 123_456)
    extra = b"\x55\x66\x77\x88\xaa\xbb\xcc\xdd"  # A part of type 7 may hold markers.
    start = first + len(hub)

    def nested(start: int) -> bytes:
        place, sensors = start + 2 + width * len(values), []
        for pillars in values:
            entries = [struct.pack("<H6f", 2, *six) for six in pillars]
            sensors.append(table(entries, width, place if absolute else 0))
            place += len(sensors[-1])
        return table(sensors, width, start if absolute else 0)

    pillars = nested(start)
    totals = table([struct.pack("<H6f", 2, *six) for six in wholes], width, start + len(pillars) if absolute else 0)
    places = {1: first, 3: start, 4: start + len(pillars), 7: start + len(pillars) + len(totals)}
    index = b"".join(struct.pack("<H", kind) + place.to_bytes(width, "little") for kind, place in places.items())
    body = bytes([width]) + index + bytes(padding) + hub + pillars + totals + extra
    return b"\x55\x66\x77\x88" + body + struct.pack("<H", sum(body) & 0xFFFF) + b"\xaa\xbb\xcc\xdd"


def test_a_frame_by_hand_is_decoded() -> None:
    body = BY_HAND[4:-4]
    assert sum(body[:-2]) & 0xFFFF == int.from_bytes(body[-2:], "little")

    runs, losses = feed_framer(ONE.framer(), [BY_HAND])

    samples = decode_runs(ONE, runs)
    assert samples.values[0].tolist() == [[1, 2, 3, 4, 5, 6, 1, 2, 3, -1, -2, -3]]
    assert samples.seq is not None and samples.seq.tolist() == [1]
    assert samples.t_device_ns is not None and samples.t_device_ns.tolist() == [1_000_000_000]
    assert losses == []
    assert [field.name for field in ONE.fields()][::6] == ["sensor1_pillar1_force_x_n", "sensor1_force_x_n"]


def test_what_is_encoded_for_one_pillar_is_the_frame_by_hand() -> None:
    values = np.array([[1, 2, 3, 4, 5, 6, 1, 2, 3, -1, -2, -3]], dtype=np.float32)
    sent = Samples((values,), seq=np.array([1]), t_device_ns=np.array([1_000_000_000]))
    assert ONE.encode(sent).tobytes() == BY_HAND


@given(
    width=st.integers(1, 8),
    absolute=st.booleans(),
    padding=st.integers(0, 9),
    sensors=st.integers(1, 2),
    seed=st.integers(0, 1 << 30),
)
def test_tables_of_any_width_padding_and_base_are_read(
    width: int, absolute: bool, padding: int, sensors: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    pillars = 2 if width == 1 else 9
    if width == 1 and sensors == 2:
        pillars = 1  # Offsets of 8 bits reach no further.
    values = rng.normal(0, 9, (sensors, pillars, 6)).astype(np.float32)
    wholes = rng.normal(0, 9, (sensors, 6)).astype(np.float32)
    sensor = Contactile(sensors=sensors, pillars=pillars)
    sent = frame(values.tolist(), wholes.tolist(), width=width, absolute=absolute, padding=padding)

    runs, losses = feed_framer(sensor.framer(), [sent])

    samples = decode_runs(sensor, runs)
    assert samples.values[0].tolist() == [[*values.ravel().tolist(), *wholes.ravel().tolist()]]
    assert samples.seq is not None and samples.seq.tolist() == [77] and losses == []


@pytest.mark.parametrize("slip", [False, True])
@given(seed=st.integers(0, 1 << 30))
def test_what_is_encoded_is_decoded(slip: bool, seed: int) -> None:
    sensor = Contactile(slip=slip)
    sent = made.samples("contactile", sensor, 6, seed)
    assert are_equal(sensor.decode(sensor.encode(sent)), sent)


def test_the_blocks_of_slip_stand_where_the_protocol_says() -> None:
    sensor = Contactile(sensors=1, pillars=1, slip=True)
    sent = made.samples("contactile", sensor, 1)
    for block, value in zip(sent.values, (0.0, -2, 0.5, 2, 12.5), strict=True):
        block[:] = value
    body = sensor.encode(sent)[0].tobytes()[4:-4]

    index = [struct.unpack_from("<HH", body, 1 + 4 * row) for row in range(5)]
    assert [kind for kind, _ in index] == [1, 3, 4, 5, 6]
    assert body[index[3][1] :][:15].hex() == "01000400010004000100fe0000003f"  # state -2, friction 0.5
    assert body[index[4][1] :][:15].hex() == "010004000100020000484100004841"


def test_before_the_watch_for_slip_began_have_no_sample() -> None:
    plain, watched = Contactile(), Contactile(slip=True)
    before = split_frames(plain, plain.encode(made.samples("contactile", plain, 4)))
    sent = made.samples("contactile", watched, 3)

    runs, losses = feed_framer(watched.framer(), [*before, *split_frames(watched, watched.encode(sent))])

    assert len(decode_runs(watched, runs)) in (
        3,
        0,
    )  # 0: the counter's jump between the two is taken for a new session
    assert {loss.cause for loss in losses} <= {"stale"}
    assert len(watched.decode(plain.encode(made.samples("contactile", plain, 4)))) == 0


def test_a_controller_with_other_sensors_is_named() -> None:
    runs, _ = feed_framer(ONE.framer(), [BY_HAND])
    with pytest.raises(DeviceError, match=r"sensors with 1 pillars.*2 with 9"):
        Contactile().decode(runs[0].frames)


@pytest.mark.parametrize(
    ("place", "value"),
    [(4, 0), (4, 9), (8, 1), (10, 0xFF), (6, 0x20), (5, 3), (31, 9), (33, 5), (37, 7), (65, 3)],
    ids=["width 0", "width 9", "offset high", "two hubs", "overlap", "no hub", "sensors", "offset", "pillar", "type"],
)
def test_tables_that_contradict_themselves_make_no_frame(place: int, value: int) -> None:
    broken = bytearray(BY_HAND)
    broken[place] = value
    broken[-6:-4] = (sum(broken[4:-6]) & 0xFFFF).to_bytes(2, "little")
    assert not pts.are_valid(np.frombuffer(bytes(broken), np.uint8)[None])[0]
    assert pts.are_valid(np.frombuffer(BY_HAND, np.uint8)[None])[0]


def test_frames_of_two_layouts_in_one_batch_are_told_apart() -> None:
    values, wholes = [[[1.0] * 6]], [[2.0] * 6]
    absolute_frame = frame(values, wholes, width=2, absolute=True, padding=3)
    relative_frame = frame(values, wholes, width=2, absolute=False, padding=3)
    frames = np.frombuffer(absolute_frame + relative_frame + absolute_frame, np.uint8).reshape(3, -1)

    layouts = {tuple(rows.tolist()) for rows, layout in pts.layouts(frames) if layout is not None}

    assert layouts == {(0, 2), (1,)}
    assert ONE.decode(frames).values[0].tolist() == [[1.0] * 6 + [2.0] * 6] * 3


def session(first: int, count: int) -> list[bytes]:
    sent = made.samples("contactile", ONE, count)
    numbered = Samples(sent.values, np.arange(first, first + count), sent.t_device_ns)
    return split_frames(ONE, ONE.encode(numbered))


def counters(runs: list[FrameRun]) -> list[int]:
    seq = decode_runs(ONE, runs).seq
    return [] if seq is None else seq.tolist()


@pytest.mark.parametrize("last", [90_000, 10, (1 << 32) - 41], ids=["ahead", "behind", "before it went round"])
def test_frames_of_the_last_session_are_thrown_away(last: int) -> None:
    framer = ONE.framer()
    chunks = [(row, data) for row, data in enumerate(session(last, 40))]
    chunks += [(2_000_000 * row, data) for row, data in enumerate(session(5000, 400), start=1)]

    runs, losses = framer.feed(Chunks.from_pairs(chunks[:100]))
    assert runs == [] and framer.account.pending == framer.account.received  # not known yet
    later_runs, lost = framer.feed(Chunks.from_pairs(chunks[100:]))

    assert counters(later_runs) == list(range(5000, 5400))
    assert [(loss.cause, loss.frames, loss.bytes) for loss in losses + lost] == [("stale", 0, 40 * len(BY_HAND))]
    assert framer.account.pending == 0


def test_without_a_jump_nothing_is_thrown_away_and_later_jumps_are_left_to_the_counter() -> None:
    framer = ONE.framer()
    first_session = session((1 << 32) - 100, 150)[:140] + session(45, 300)  # it goes round, and five packets are lost
    chunks = [(2_000_000 * row, data) for row, data in enumerate(first_session + session(90_000, 20))]

    runs, losses = framer.feed(Chunks.from_pairs(chunks))

    expected = [number % (1 << 32) for number in range((1 << 32) - 100, (1 << 32) + 40)]
    assert counters(runs) == [*expected, *range(45, 345), *range(90_000, 90_020)]
    assert losses == []


def test_a_short_recording_is_given_out_at_its_end() -> None:
    runs, losses = feed_framer(ONE.framer(), session(7, 3))
    assert counters(runs) == [7, 8, 9] and losses == []


def test_the_device_takes_the_rate_of_the_opening() -> None:
    device = device_for(Contactile(rate_hz=250))
    assert hold_dialogue(Contactile(rate_hz=250).opening({}), device).sent == [b"f250\n", b"s\n"]
    assert device.rate_hz == 250 and device.streaming
    assert hold_dialogue(Contactile(slip=True).opening({}), device).sent[1] == b"S\n"
    assert hold_dialogue(Contactile().taring(), device).sent == [b"z\n"]


def test_a_rate_that_the_controller_does_not_know_is_refused() -> None:
    with pytest.raises(UsageError, match="100, 250, 500, 1000"):
        Contactile(rate_hz=400)
    with pytest.raises(UsageError, match="at least 1"):
        Contactile(sensors=0)
