"""Real-time scheduling: refused in one sentence where the system does not allow it, and taken back."""

from __future__ import annotations

import os

import pytest

from tacpipe.errors import UsageError
from tacpipe.live import wire


def test_a_system_that_does_not_allow_it_is_named_before_the_session(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*arguments: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refused)
    with pytest.raises(UsageError, match="rtprio 20"):
        wire.check()
    wire.realtime(wire.MODEL)  # a process whose rights ended meanwhile goes on as ever
    wire.ordinary()


def test_all_threads_are_set_and_set_back(monkeypatch: pytest.MonkeyPatch) -> None:
    set_to: dict[int, tuple[int, int]] = {}

    def noted(thread: int, policy: int, param: os.sched_param) -> None:
        set_to[thread] = policy, param.sched_priority

    monkeypatch.setattr(os, "sched_setscheduler", noted)
    wire.realtime(wire.RECORDER)
    assert set(set_to.values()) == {(os.SCHED_RR, wire.RECORDER)} and os.getpid() in set_to
    wire.ordinary()
    assert set(set_to.values()) == {(os.SCHED_OTHER, 0)}
