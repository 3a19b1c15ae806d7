"""Replay power failures on real file systems block by block: `make test-power` runs this, which takes minutes."""

import os
from pathlib import Path

import pytest

from tests.power import block_log, machine, trials

needs_machine = [
    pytest.mark.skipif("TACPIPE_TEST_POWER" not in os.environ, reason="`make test-power` runs it"),
    pytest.mark.skipif(bool(machine.lacking()), reason=f"{machine.lacking()} is not installed"),
]


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=needs_machine) for kind in machine.MAKE])
def test_what_was_answered_outlasts_a_loss_of_power_at_any_write(kind: str, tmp_path: Path) -> None:
    results = trials.trial(kind, tmp_path, step=int(os.environ.get("TACPIPE_TEST_POWER") or 1))
    assert results.states and not results.wrong, "\n".join(results.wrong)


def entry(sector: int, flags: int = 0, data: bytes = b"") -> block_log.Entry:
    return block_log.Entry(sector, len(data), flags, data)


def test_what_was_flushed_is_on_the_disk_and_of_the_rest_any_part_may_be() -> None:
    first, two, three = (entry(512 * number, data=bytes([number]) * 512) for number in (1, 2, 3))
    log = [first, two, entry(0, block_log.FLUSH), entry(0, block_log.MARK, b"done\0"), three, entry(0, block_log.FLUSH)]
    states = list(block_log.states(log, seed=0))
    assert [state.passed for state in states] == [(), (), ("done",), ("done",), ("done",)]
    assert all(set(state.writes) >= {first, two} for state in states[1:])
    assert set(states[0].writes) <= {first, two} and set(states[-1].writes) == {first, two, three}


def test_a_forced_write_is_on_the_disk_though_nothing_was_flushed(tmp_path: Path) -> None:
    loose, forced = entry(0, data=b"a" * 512), entry(512, block_log.FUA, b"b" * 512)
    *_, last = block_log.states([loose, forced], seed=0)
    assert last.writes == [forced]
    image = tmp_path / "disk"
    image.write_bytes(bytes(1024))
    block_log.write(last, image)
    assert image.read_bytes() == bytes(512) + b"b" * 512
