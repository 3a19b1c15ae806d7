"""Test readers with arbitrary bytes: they return values or one sentence, without traceback, hang or excessive memory."""

import pytest
from hypothesis import HealthCheck, given, settings

from tacpipe.clouds.files import SUFFIXES
from tacpipe.errors import TacpipeError
from tacpipe.plugins import registry
from tests.promises.counts import count
from tests.promises.limits import bound_memory, is_sentence
from tests.promises.mutations import inputs
from tests.promises.targets import TREES, Target, targets
from tests.sensors.test_every_sensor import CASES

FOUND = targets()
READERS = [name for name in FOUND if not name.startswith("sensor-")]
FEW, SLOW_FEW, MANY, SLOW_MANY = 40, 8, 4000, 400  # inputs of a target


def test_no_format_sensor_or_kind_of_cloud_is_forgotten() -> None:
    formats = registry.entry_points()[registry.FORMATS]
    built_in = {name for name, target in formats.items() if target.startswith(("tacpipe.", "tacpipe_stages."))}
    assert built_in == set(TREES)
    assert {name for name, target in registry.sensors().items() if "tacpipe." in target} <= set(CASES)
    assert {f"cloud{suffix}" for suffix in SUFFIXES} <= set(FOUND)


@pytest.mark.parametrize("name", FOUND)
def test_valid_examples_are_read(name: str) -> None:
    examples = FOUND[name].examples()
    assert len(examples) > 0
    for example in examples:
        FOUND[name].run(example)


def try_inputs(target: Target, examples: int) -> None:
    """Try so many inputs; each is read, or refused with a sentence."""
    refused = ran = 0

    @settings(max_examples=examples, deadline=None, suppress_health_check=list(HealthCheck), database=None)
    @given(inputs(target.examples()))
    def attempt(data: bytes) -> None:
        nonlocal refused, ran
        ran += 1
        try:
            target.run(data)
        except TacpipeError as error:
            assert is_sentence(str(error)), str(error)
            refused += 1

    with bound_memory():
        attempt()
    count("inputs fuzzed", ran)
    count("hostile inputs refused", refused)


@pytest.mark.parametrize("name", READERS)
def test_changed_bytes_are_read_or_refused_with_a_sentence(name: str) -> None:
    try_inputs(FOUND[name], SLOW_FEW if FOUND[name].slow else FEW)


@pytest.mark.faults
@pytest.mark.parametrize("name", READERS)
def test_bytes_changed_in_thousands_of_ways_are_read_or_refused(name: str) -> None:
    try_inputs(FOUND[name], SLOW_MANY if FOUND[name].slow else MANY)
