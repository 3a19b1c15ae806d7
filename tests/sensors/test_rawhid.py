"""Reports of the reference layout are read, and what breaks the layout is no report."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import UsageError
from tacpipe.sensors.generic import RawHid
from tacpipe.testing.frames import are_equal, decode_runs, feed_framer
from tests.sensors import made

BY_HAND = bytes.fromhex(
    "ABCD" + "0001 0203 03FF 0000 FFFF 1234 0005 0006 0007 0008 0009 0400".replace(" ", "") + "00" * 36 + "BEEF"
)


def test_a_report_by_hand_is_decoded() -> None:
    runs, losses = feed_framer(RawHid().framer(), [BY_HAND])

    samples = decode_runs(RawHid(), runs)

    assert samples.values[0].tolist() == [[1, 515, 1023, 0, 65535, 4660, 5, 6, 7, 8, 9, 1024]]
    assert samples.seq is not None and samples.seq.tolist() == [0xBEEF]
    assert losses == []


@given(seed=st.integers(0, 1 << 30))
def test_what_is_encoded_is_decoded(seed: int) -> None:
    sent = made.samples("rawhid", RawHid(), 30, seed)
    assert are_equal(RawHid().decode(RawHid().encode(sent)), sent)


@pytest.mark.parametrize(
    "report",
    [BY_HAND[:-1], BY_HAND + b"\0", b"\xab\xce" + BY_HAND[2:], BY_HAND[:40] + b"\x01" + BY_HAND[41:], b""],
    ids=["short", "long", "other marker", "no zero", "empty"],
)
def test_a_report_of_another_layout_is_malformed(report: bytes) -> None:
    runs, losses = feed_framer(RawHid().framer(), [report])
    assert runs == []
    assert [(loss.cause, loss.bytes) for loss in losses] == [("malformed", len(report))]


def test_full_speed_usb_bounds_the_rate() -> None:
    with pytest.raises(UsageError, match="1000"):
        RawHid(rate_hz=2000)
