"""Define a recording without a store, for stages that are called as plain functions."""

from collections.abc import Callable

import pytest

from tests.fake_recordings import FakeRecording


@pytest.fixture
def shard() -> Callable[..., FakeRecording]:
    """Make a recording of tables by stream name."""
    return FakeRecording
