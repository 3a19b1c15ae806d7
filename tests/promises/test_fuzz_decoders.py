"""Test decoders with arbitrary bytes: they never raise, buffer little, and do not depend on the division into chunks."""

from random import Random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tacpipe.testing import byte_faults
from tests.promises import decoding
from tests.promises.counts import count
from tests.promises.limits import bound_memory
from tests.promises.mutations import inputs
from tests.sensors.test_every_sensor import CASES

FEW, MANY = 4, 100  # inputs of a sensor
GARBAGE = 1 << 18  # bytes that have no end


def try_inputs(case: str, examples: int) -> None:
    ran = 0

    @settings(max_examples=examples, deadline=None, suppress_health_check=list(HealthCheck), database=None)
    @given(inputs(decoding.examples(case)), st.lists(st.integers(1, 400), min_size=1, max_size=5), st.integers(1, 50))
    def attempt(data: bytes, sizes: list[int], at_once: int) -> None:
        nonlocal ran
        ran += 1
        expected = decoding.samples(case, decoding.chunks(case, data, (len(data) or 1,)))
        assert decoding.samples(case, decoding.chunks(case, data, sizes), at_once) == expected

    with bound_memory():
        attempt()
    count("inputs fuzzed", ran)


@pytest.mark.parametrize("case", CASES)
def test_the_same_bytes_give_the_same_samples_however_they_are_cut(case: str) -> None:
    try_inputs(case, FEW)


@pytest.mark.faults
@pytest.mark.parametrize("case", CASES)
def test_bytes_changed_in_many_ways_give_the_same_samples_however_they_are_cut(case: str) -> None:
    try_inputs(case, MANY)


@pytest.mark.faults
@pytest.mark.parametrize("case", [case for case in CASES if byte_faults.is_byte_stream(decoding.sensor(case))])
@pytest.mark.parametrize("kind", ["noise", "markers", "zeros", "beginnings"])
def test_garbage_without_end_is_not_kept(case: str, kind: str) -> None:
    random = Random(0)
    example = decoding.examples(case)[0]
    unit = {
        "noise": random.randbytes(1 << 12),
        "markers": example[:2],
        "zeros": b"\0",
        "beginnings": example[: max(4, len(example) // decoding.FRAMES // 2)],
    }[kind]
    garbage = (unit * (GARBAGE // len(unit) + 1))[:GARBAGE]
    with bound_memory():
        decoding.samples(case, decoding.chunks(case, garbage, (4096,)), 1, 10_000_000)
    count("inputs fuzzed")
