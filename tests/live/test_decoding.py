"""Test which chunks of a live stream are decoded before a due row, and which can wait."""

import numpy as np
import pytest

from tacpipe.live.decoding import Decoder
from tacpipe.recording import rig as rigs
from tacpipe.recording.spool import StreamNote
from tacpipe.recording.station import LOST
from tacpipe.sensors.encoding import split_frames
from tacpipe.sensors.framing import Chunks
from tests.sensors import made

ROW_NS = 10**12


def decoder_and_packets(sensor: str) -> tuple[Decoder, list[bytes]]:
    stream_sensor = rigs.build_sensor(sensor, {}, "stream")
    samples = made.samples(sensor, stream_sensor, 4, 1)
    return Decoder(stream_sensor), split_frames(stream_sensor, stream_sensor.encode(samples))


@pytest.mark.parametrize(("arrived_ns", "waits"), [(ROW_NS - 1, True), (ROW_NS, True), (ROW_NS + 1, False)])
def test_a_row_waits_for_what_arrived_by_then(arrived_ns: int, waits: bool) -> None:
    decoder, packets = decoder_and_packets("xela")
    assert not decoder.may_contain(ROW_NS)
    decoder.take(Chunks.from_pairs([(arrived_ns, packets[0]), (ROW_NS + 5, packets[1])]))
    assert decoder.may_contain(ROW_NS) == waits


def test_a_row_waits_for_the_rest_of_a_frame_that_began_before_it() -> None:
    decoder, pieces = decoder_and_packets("tfmini")
    data = b"".join(pieces)
    cut = len(pieces[0]) // 2
    decoder.take(Chunks.from_pairs([(ROW_NS - 1, data[:cut])]))
    assert decoder.batches() == []
    assert not decoder.may_contain(ROW_NS)  # nothing more came
    decoder.take(Chunks.from_pairs([(ROW_NS + 1, data[cut:])]))
    assert decoder.may_contain(ROW_NS)
    stamps = np.concatenate([batch.t_ns for batch in decoder.batches()])
    assert stamps[0] <= ROW_NS + 1


def test_a_row_waits_for_what_a_lost_link_leaves() -> None:
    decoder, _ = decoder_and_packets("xela")
    decoder.take(StreamNote(ROW_NS + 1, "stream", LOST))
    assert decoder.may_contain(ROW_NS)
