"""Frames are found again after anything that may happen to bytes, and every byte is accounted for."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.arrays import Bools, Bytes
from tacpipe.sensors import checks, framing
from tacpipe.sensors.byte_framer import ByteFramer, LineFramer
from tacpipe.sensors.framing import Chunks, FrameRun, Framing, FramingLoss, PacketFramer


def sum_is_right(frames: Bytes) -> Bools:
    return np.asarray(checks.sum8(frames[:, :-1]) == frames[:, -1])


def sum16_is_right(frames: Bytes) -> Bools:
    return np.asarray(checks.sum16(frames[:, :-2]) == frames[:, -2] + 256 * frames[:, -1].astype(int))


def inner_sum_is_right(frames: Bytes) -> Bools:
    body = frames[:, 4:-4]
    if body.shape[1] < 3:
        return np.zeros(len(frames), dtype=bool)
    return np.asarray(checks.sum16(body[:, :-2]) == body[:, -2] + 256 * body[:, -1].astype(int))


PLAIN = Framing(marker=b"\xaa\x55", size=34, lock=3, confirm=1)
SUMMED = Framing(marker=b"\x59\x59", size=9, check=sum_is_right, confirm=1)
STRONG = Framing(marker=b"\xaa\x07\x08", size=16, check=sum16_is_right)
TAILED = Framing(tail=b"\r\n", size=42, lock=3)
TOLD = Framing(
    marker=b"\x9a\x00", header=5, sizes=lambda head: head[:, 2].astype(np.int64) + 3, max_size=40, check=sum16_is_right
)
ENCLOSED = Framing(marker=b"\x55\x66\x77\x88", tail=b"\xaa\xbb\xcc\xdd", max_size=200, check=inner_sum_is_right)
KINDS = {"plain": PLAIN, "summed": SUMMED, "strong": STRONG, "tailed": TAILED, "told": TOLD, "enclosed": ENCLOSED}


def numbered_frames(kind: str, count: int, seed: int) -> list[bytes]:
    """Return frames of random content, the number of each in its first free bytes."""
    rng = np.random.default_rng(seed)
    frames = []
    for number in range(count):
        body = bytes([number % 251, number // 251]) + rng.integers(0, 256, 40, dtype=np.uint8).tobytes()
        if kind == "plain":
            frames.append(b"\xaa\x55" + body[:32])
        elif kind == "summed":
            head = b"\x59\x59" + body[:6]
            frames.append(head + bytes([sum(head) & 255]))
        elif kind == "strong":
            head = b"\xaa\x07\x08" + body[:11]
            frames.append(head + sum(head).to_bytes(2, "little"))
        elif kind == "tailed":
            frames.append(body[:40] + b"\r\n")
        elif kind == "told":
            size = int(rng.integers(4, 30))
            head = b"\x9a\x00" + bytes([size]) + body[: size - 2]
            frames.append(head + sum(head).to_bytes(2, "little"))
        else:
            inner = body[:32] + sum(body[:32]).to_bytes(2, "little")
            frames.append(b"\x55\x66\x77\x88" + inner + b"\xaa\xbb\xcc\xdd")
    return frames


def fed(framer: framing.Framer, data: bytes, sizes: list[int]) -> tuple[list[FrameRun], list[FramingLoss]]:
    """Feed ``data`` in pieces of these sizes over and over, a nanosecond after one another."""
    runs: list[FrameRun] = []
    losses: list[FramingLoss] = []
    place, step = 0, 0
    while place < len(data):
        piece = data[place : place + sizes[step % len(sizes)]]
        new_runs, lost = framer.feed(Chunks.from_pairs([(step, piece)]))
        runs, losses = runs + new_runs, losses + lost
        place, step = place + len(piece), step + 1
    new_runs, lost = framer.flush()
    return runs + new_runs, losses + lost


def frames_of(runs: list[FrameRun]) -> list[bytes]:
    return [bytes(frame) for run in runs for frame in run.frames]


@pytest.mark.parametrize("kind", KINDS)
@given(seed=st.integers(0, 1000), sizes=st.lists(st.integers(1, 300), min_size=1, max_size=5))
def test_clean_bytes_are_given_out_whole_however_they_are_cut(kind: str, seed: int, sizes: list[int]) -> None:
    sent = numbered_frames(kind, 30, seed)
    framer = ByteFramer(KINDS[kind])

    runs, losses = fed(framer, b"".join(sent), sizes)

    head = int(kind == "tailed")  # Its start is only known after a tail.
    assert frames_of(runs) == sent[head:]
    assert framer.account.pending == 0
    assert {loss.cause for loss in losses} <= {framing.START}


@pytest.mark.parametrize("kind", KINDS)
@given(
    seed=st.integers(0, 1000),
    sizes=st.lists(st.integers(1, 300), min_size=1, max_size=5),
    faults=st.lists(
        st.tuples(st.integers(5, 90), st.sampled_from(["noise", "cut", "burst"]), st.integers(1, 60)), max_size=4
    ),
)
def test_after_noise_cuts_and_bursts_no_frame_is_wrong_and_few_are_lost(
    kind: str, seed: int, sizes: list[int], faults: list[tuple[int, str, int]]
) -> None:
    sent = numbered_frames(kind, 100, seed)
    rng = np.random.default_rng(seed)
    pieces, harmed = list(sent), set()
    for row, fault, size in faults:
        noise = rng.integers(0, 256, size, dtype=np.uint8).tobytes()
        if fault == "noise":
            pieces[row] = noise + pieces[row]
        elif fault == "cut":
            pieces[row] = pieces[row][: max(1, len(pieces[row]) - size)]
            harmed.add(row)
        elif KINDS[kind].check is not None:
            pieces[row] = bytes(len(pieces[row]))
            harmed.add(row)
    data = b"".join(pieces)
    framer = ByteFramer(KINDS[kind])

    runs, losses = fed(framer, data, sizes)

    frames = frames_of(runs)
    assert set(frames) <= set(sent)  # nothing that was not sent
    assert [sent.index(frame) for frame in frames] == sorted(sent.index(frame) for frame in frames)
    assert framer.account.framed + framer.account.lost == len(data) == framer.account.received
    assert sum(loss.bytes for loss in losses) == framer.account.lost
    assert len(frames) >= len(sent) - 2 - len(harmed) - 4 * len(faults)


@st.composite
def mixtures(draw: st.DrawFn, kind: str) -> bytes:
    """Draw a stream of frames in which anything stands between them, whole frames, parts of frames and marks included."""
    sent = numbered_frames(kind, 30, draw(st.integers(0, 1000)))
    framing = KINDS[kind]
    parts = st.tuples(st.integers(0, 29), st.integers(0, 60), st.integers(0, 60))
    between = (
        st.binary(max_size=80)
        | st.sampled_from([framing.marker, framing.tail, framing.marker * 3 + framing.tail])
        | parts.map(lambda part: sent[part[0]][part[1] : part[1] + part[2]])
        | st.integers(0, 29).map(lambda number: sent[number])
    )
    junk = draw(st.dictionaries(st.integers(0, 30), st.lists(between, max_size=3), max_size=5))
    return b"".join(b"".join(junk.get(row, [])) + (sent[row] if row < 30 else b"") for row in range(31))


sizes_of_pieces = st.lists(st.integers(1, 90) | st.integers(200, 2000), min_size=1, max_size=6)


@pytest.mark.parametrize("kind", KINDS)
@given(data=st.data(), sizes=sizes_of_pieces)
def test_after_every_piece_each_byte_is_framed_lost_or_pending_and_frames_stand_in_the_bytes_in_order(
    kind: str, data: st.DataObject, sizes: list[int]
) -> None:
    stream, framing = data.draw(mixtures(kind)), KINDS[kind]
    framer = ByteFramer(framing)
    runs: list[FrameRun] = []
    losses: list[FramingLoss] = []
    ends: list[int] = []  # End of each piece, whose number is its arrival time.
    for step in range(len(stream) + 1):
        start = ends[-1] if ends else 0
        piece = stream[start : start + sizes[step % len(sizes)]]
        ends.append(start + len(piece))
        new_runs, lost = framer.feed(Chunks.from_pairs([(step, piece)])) if piece else framer.flush()
        runs, losses = runs + new_runs, losses + lost
        assert framer.account.received == ends[-1]
        assert framer.account.framed == sum(map(len, frames_of(runs)))
        assert framer.account.lost == sum(loss.bytes for loss in losses)
        assert framer.account.pending >= 0
        if not piece:
            break
    assert framer.account.pending == 0
    place = 0
    for frame, t_ns in zip(frames_of(runs), [t_ns for run in runs for t_ns in run.t_ns.tolist()], strict=True):
        begins = stream.index(frame, place)
        place = begins + len(frame)
        assert ends[t_ns] >= place  # it did not come before its last byte
        assert frame.startswith(framing.marker) and frame.endswith(framing.tail)
        assert framing.check is None or framing.check(np.frombuffer(frame, np.uint8)[None])[0]
    assert all(loss.bytes > 0 and loss.frames >= 0 for loss in losses)


@pytest.mark.parametrize("kind", KINDS)
@given(data=st.data(), sizes=sizes_of_pieces)
def test_how_a_harmed_stream_is_cut_into_pieces_changes_no_frame(
    kind: str, data: st.DataObject, sizes: list[int]
) -> None:
    stream = data.draw(mixtures(kind))
    frame_lists = [frames_of(fed(ByteFramer(KINDS[kind]), stream, pieces)[0]) for pieces in (sizes, [1], [len(stream)])]
    assert frame_lists[0] == frame_lists[1] == frame_lists[2]


@given(st.lists(st.binary(max_size=20) | st.sampled_from([b"\n", b"12\n", b"\r\n", b"x\n"])), sizes_of_pieces)
def test_lines_too_account_for_every_byte_and_are_the_same_however_they_are_cut(
    pieces: list[bytes], sizes: list[int]
) -> None:
    stream, line_lists = b"".join(pieces), []
    for cut in (sizes, [1], [max(1, len(stream))]):
        framer = LineFramer(lambda line: line.isdigit())
        runs, losses = fed(framer, stream, cut)
        assert framer.account.pending == 0 and framer.account.received == len(stream)
        assert framer.account.lost == sum(loss.bytes for loss in losses)
        line_lists.append([line for run in runs for line in run.frames])
    complete_lines = [line.strip() for line in stream.split(b"\n")[1:-1]]
    assert line_lists == [[line for line in complete_lines if line.isdigit()]] * 3


@given(st.lists(st.binary(max_size=20) | st.integers(0, 9).map(lambda row: numbered_frames("strong", 10, 0)[row])))
def test_packets_are_frames_or_losses_one_for_one(packets: list[bytes]) -> None:
    framer = PacketFramer([16], sum16_is_right)
    runs, losses = framer.feed(Chunks.from_pairs(list(enumerate(packets))))
    good = [number for number, packet in enumerate(packets) if packet in numbered_frames("strong", 10, 0)]
    assert [t_ns for run in runs for t_ns in run.t_ns.tolist()] == good
    assert frames_of(runs) == [packets[number] for number in good]
    bad = [(number, len(packet)) for number, packet in enumerate(packets) if number not in good]
    assert sorted((loss.t_ns, loss.bytes) for loss in losses) == bad
    account = framer.account
    assert (account.framed, account.lost) == (16 * len(good), sum(size for _, size in bad))
    assert account.pending == 0


@pytest.mark.parametrize("kind", KINDS)
def test_the_first_two_frames_after_a_disturbance_are_given_out(kind: str) -> None:
    sent = numbered_frames(kind, 40, 3)
    framer = ByteFramer(KINDS[kind])

    runs, _ = fed(framer, b"".join(sent[:20]) + b"\x17" * 77 + b"".join(sent[20:]), [11])

    frames = frames_of(runs)
    lag = int(kind == "tailed")  # its first frame begins behind bytes of which nobody knows that they end there
    assert sent[20 + lag] in frames and sent[21] in frames


def test_a_garbled_frame_is_told_from_noise_and_from_a_cut() -> None:
    sent = numbered_frames("strong", 30, 0)
    flipped = sent[10][:8] + bytes([sent[10][8] ^ 4]) + sent[10][9:]
    stream = b"".join([*sent[:10], flipped, *sent[11:15], b"\x01\x02\x03", *sent[15:20], sent[20][:9], *sent[21:]])

    _, losses = fed(ByteFramer(STRONG), stream, [64])

    assert [(loss.cause, loss.frames, loss.bytes) for loss in losses] == [
        (framing.GARBLED, 1, 16),
        (framing.NOISE, 0, 3),
        (framing.CUT, 1, 9),
    ]


def test_a_frame_arrives_when_its_last_byte_does() -> None:
    sent = numbered_frames("strong", 3, 0)
    data = b"".join(sent)

    runs, _ = ByteFramer(STRONG).feed(
        Chunks.from_pairs([(100, data[:15]), (200, data[15:17]), (300, data[17:40]), (400, data[40:])])
    )

    assert runs[0].t_ns.tolist() == [200, 300, 400]


def test_marks_in_a_payload_that_holds_still_give_nothing_until_it_moves() -> None:
    repeating = [b"\xaa\x55" + bytes([number]) + b"\xaa\x55" * 15 + b"\x00" for number in range(20)]
    moving = numbered_frames("plain", 30, 0)
    framer = ByteFramer(PLAIN)

    quiet, _ = framer.feed(Chunks.from_pairs([(0, repeating[0][7:] + b"".join(repeating[1:]))]))
    runs, losses = fed(framer, b"".join(moving), [50])

    assert not quiet
    assert frames_of(runs) == repeating[1:] + moving
    assert [loss.cause for loss in losses] == [framing.START]


def test_garbage_without_end_is_thrown_away_and_not_kept() -> None:
    rng = np.random.default_rng(0)
    framer = ByteFramer(SUMMED)
    for step in range(200):
        framer.feed(Chunks.from_pairs([(step, rng.integers(0, 80, 1000, dtype=np.uint8).tobytes())]))

    assert framer.account.pending <= SUMMED.max_size + 1000
    assert framer.account.framed == 0


def test_packets_of_another_size_or_sum_are_malformed() -> None:
    good = numbered_frames("strong", 4, 0)
    framer = PacketFramer([16], sum16_is_right)
    bad = good[1][:-1] + b"\x00"

    runs, losses = framer.feed(Chunks.from_pairs([(1, good[0]), (2, bad), (3, b"xy"), (4, good[2]), (5, good[3])]))

    assert frames_of(runs) == [good[0], good[2], good[3]]
    assert [t_ns for run in runs for t_ns in run.t_ns] == [1, 4, 5]
    assert [(loss.t_ns, loss.cause, loss.bytes) for loss in losses] == [(2, "malformed", 16), (3, "malformed", 2)]


def test_a_line_that_is_none_is_lost_and_the_others_stay() -> None:
    framer = LineFramer(lambda line: line.isdigit())

    runs, losses = fed(framer, b"34\n12\n1x\r\n99\r\n7", [4])

    assert frames_of(runs) == [b"12", b"99"] or frames_of(runs) == [b"34", b"12", b"99"]
    assert [(loss.cause, loss.frames) for loss in losses[-2:]] == [(framing.GARBLED, 1), (framing.END, 0)]
    assert framer.account.pending == 0


def test_a_lock_needs_as_many_frames_as_the_framing_says() -> None:
    sent = numbered_frames("plain", 3, 0)
    eager, careful = ByteFramer(replace(PLAIN, lock=2)), ByteFramer(replace(PLAIN, lock=4))

    assert frames_of(eager.feed(Chunks.from_pairs([(0, b"".join(sent))]))[0]) == sent[:2]
    assert frames_of(careful.feed(Chunks.from_pairs([(0, b"".join(sent))]))[0]) == []


def test_the_first_frame_behind_garbage_is_found_wherever_the_bytes_are_cut() -> None:
    framing = Framing(
        tail=b"\r\n", size=10, max_size=64, check=lambda rows: np.asarray((rows[:, :8] > 100).all(axis=1)), lock=3
    )
    frames = b"".join(bytes([101 + number]) * 8 + b"\r\n" for number in range(6))
    data = b"x" * (framing.max_size + 50) + b"\r\n" + frames
    for cut in range(1, len(data)):
        framer = ByteFramer(framing)
        runs = [
            *framer.feed(Chunks.from_pairs([(1, data[:cut])]))[0],
            *framer.feed(Chunks.from_pairs([(2, data[cut:])]))[0],
        ]
        assert b"".join(run.frames.tobytes() for run in [*runs, *framer.flush()[0]]) == frames, cut
