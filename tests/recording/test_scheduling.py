"""Recordings run before ordinary programs on request, and only then."""

import os

import pytest

from tacpipe.errors import UsageError
from tacpipe.recording import scheduling


def test_a_system_that_does_not_allow_it_is_named_before_the_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*arguments: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refused)
    with pytest.raises(UsageError, match="rtprio 20"):
        scheduling.check_realtime()
    scheduling.realtime(scheduling.MODEL)  # a process whose rights ended meanwhile goes on as ever
    scheduling.ordinary()


def test_all_threads_are_set_and_set_back(monkeypatch: pytest.MonkeyPatch) -> None:
    set_to: dict[int, tuple[int, int]] = {}

    def noted(thread: int, policy: int, param: os.sched_param) -> None:
        set_to[thread] = policy, param.sched_priority

    monkeypatch.setattr(os, "sched_setscheduler", noted)
    scheduling.realtime(scheduling.RECORDER)
    assert set(set_to.values()) == {(os.SCHED_RR, scheduling.RECORDER)} and os.getpid() in set_to
    scheduling.ordinary()
    assert set(set_to.values()) == {(os.SCHED_OTHER, 0)}
