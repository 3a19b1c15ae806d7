"""When frames go out."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import UsageError
from tests.emulation.transmission import FramePace, next_due_ns

TAKEN = np.arange(0, 20_000_000_000, 1_000_000)


def test_frames_are_late_by_the_jitter_and_do_not_drift() -> None:
    late = next_due_ns(TAKEN, FramePace(jitter_ms=0.1), 0, np.random.default_rng(0)) - TAKEN
    assert late.min() >= 0
    assert 95_000 < late.mean() < 110_000  # Frames that wait for the previous one are a few percent later.
    assert abs(late[-2000:].mean() - late[:2000].mean()) < 20_000


@given(
    jitter=st.floats(0, 20),
    burst=st.sampled_from([0.0, 1.0, 16.0]),
    after=st.integers(0, 5_000_000_000),
    seed=st.integers(0, 99),
)
def test_frames_keep_their_order_and_never_go_out_before_they_were_taken(
    jitter: float, burst: float, after: int, seed: int
) -> None:
    due = next_due_ns(TAKEN[:3000], FramePace(jitter_ms=jitter, burst_ms=burst), after, np.random.default_rng(seed))
    assert (np.diff(due) >= 0).all()
    assert (due >= TAKEN[:3000]).all()
    assert due.min() >= after


def test_a_bridge_sends_what_it_collected_together() -> None:
    due = next_due_ns(TAKEN, FramePace(jitter_ms=0.0, burst_ms=16.0), 0, np.random.default_rng(0))
    assert (due % 16_000_000 == 0).all()
    _, burst_sizes = np.unique(due, return_counts=True)
    assert set(burst_sizes[1:-1].tolist()) == {16}


@pytest.mark.parametrize("keys", [{"jitter_ms": -1.0}, {"burst_ms": -1.0}, {"finger": 3}])
def test_a_pace_that_cannot_be_is_refused(keys: dict[str, float]) -> None:
    with pytest.raises(UsageError, match="emulate: "):
        FramePace(**keys)  # type: ignore[arg-type]
