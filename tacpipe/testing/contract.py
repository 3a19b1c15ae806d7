"""Check that a sensor decodes what it encodes, and that faults of a link neither create nor hide samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tacpipe.sensors.byte_framer import ByteFramer
from tacpipe.sensors.encoding import split_frames
from tacpipe.sensors.framing import FrameRun
from tacpipe.sensors.sensor import Frames, Samples, Sensor
from tacpipe.testing.byte_faults import LOST, Fault, FaultOutcome, deliver, draw_faults, outcome_of
from tacpipe.testing.frames import are_equal, are_nearly_equal, decode_runs, feed_framer, rows_as_bytes


@dataclass(frozen=True)
class SentFrames:
    """Frames of a sensor with their samples."""

    sensor: Sensor
    samples: Samples
    frames: list[bytes]  # frames as they are sent
    decoded: Samples  # samples that the frames contain
    numbers: dict[bytes, int]  # number of each sample by its `rows_as_bytes`


def encode_samples(sensor: Sensor, samples: Samples) -> SentFrames:
    """Return the frames of samples, which must differ from one another."""
    frames = sensor.encode(samples)
    decoded = decode_frames(sensor, frames)
    numbers = {row: number for number, row in enumerate(rows_as_bytes(decoded))}
    assert len(numbers) == len(decoded) == len(samples), "two samples are equal, and cannot be distinguished"
    return SentFrames(sensor, samples, split_frames(sensor, frames), decoded, numbers)


def decode_frames(sensor: Sensor, frames: Frames) -> Samples:
    """Return the samples of frames as `Sensor.encode` returns them, also of binary frames of several sizes."""
    if isinstance(frames, np.ndarray) or not isinstance(sensor.framer(), ByteFramer):
        return sensor.decode(frames)
    runs = [FrameRun(np.frombuffer(frame, np.uint8)[None], np.zeros(1, dtype=np.int64)) for frame in frames]
    return decode_runs(sensor, runs)


def check_round_trip(sent: SentFrames, *, is_rounded: bool = False) -> None:
    """Raise `AssertionError` unless the frames contain the samples, in the types of the fields.

    ``is_rounded`` allows for protocols that round numbers, or send orientations in another form.
    """
    kinds = [block.dtype for block in sent.decoded.values for _ in range(block.shape[1])]
    assert kinds == [np.dtype(field.type.to_pandas_dtype()) for field in sent.sensor.fields()]
    assert are_equal(sent.decoded, sent.samples) or (
        is_rounded and are_nearly_equal(sent.sensor, sent.decoded, sent.samples)
    )
    assert (sent.decoded.seq is None) == (sent.sensor.counter is None)
    assert (sent.decoded.device_seq is None) == (sent.sensor.device_counter is None)


def check_clean_frames(sent: SentFrames) -> None:
    """Raise `AssertionError` unless all frames but the first arrive over a link without faults."""
    framer = sent.sensor.framer()
    chunks = deliver(sent.sensor, sent.frames, [], np.random.default_rng(1))
    runs, losses = feed_framer(framer, chunks)
    numbers = [sent.numbers[row] for row in rows_as_bytes(decode_runs(sent.sensor, runs))]
    assert numbers == list(range(numbers[0], len(sent.frames))) and len(numbers) >= len(sent.frames) - 1
    assert framer.account.lost == sum(loss.bytes for loss in losses)
    assert framer.account.pending == 0
    assert {loss.cause for loss in losses} <= {"start"}


def check_faults(sent: SentFrames, seed: int = 0) -> int:
    """Raise `AssertionError` if faults of a link create a sample, or lose one that no loss reports.

    Returns the number of faults that the protocol cannot detect, which may be above 0 if it has no checksum.
    """
    rng = np.random.default_rng(seed)
    faults = list(draw_faults(sent.sensor, sent.frames, rng))
    framer = sent.sensor.framer()
    runs, losses = feed_framer(framer, deliver(sent.sensor, sent.frames, faults, rng))

    outcomes = [outcome_of(sent.sensor, sent.frames, fault) for fault in faults]
    rows = rows_as_bytes(decode_runs(sent.sensor, runs))
    numbers = [sent.numbers[row] for row in rows if row in sent.numbers]
    invented = {row for outcome in outcomes for row in outcome.invented}
    assert {row for row in rows if row not in sent.numbers} <= invented
    assert numbers == sorted(set(numbers))
    assert framer.account.received == framer.account.framed + framer.account.lost
    assert framer.account.lost == sum(loss.bytes for loss in losses)
    assert _silent_losses(faults, outcomes) == []
    return sum(bool(outcome.invented) for outcome in outcomes)


def _silent_losses(faults: Sequence[Fault], outcomes: Sequence[FaultOutcome]) -> list[tuple[int, str]]:
    """Return row and kind of the faults that lose a sample without a report, though a frame arrived."""
    return [
        (fault.row, fault.kind)
        for fault, outcome in zip(faults, outcomes, strict=True)
        if outcome.missing and not outcome.invented and not outcome.is_reported and fault.kind != LOST
    ]
