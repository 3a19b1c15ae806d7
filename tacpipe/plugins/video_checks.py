"""Settings of stages that read video files: whether frames are verified, and whether a cut file is read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

from tacpipe.plugins.params import added
from tacpipe.plugins.stream_selection import StreamSelection


@dataclass(frozen=True, kw_only=True)
class VideoChecks(StreamSelection):
    """Params of a stage that reads videos."""

    verify_video: bool = added(True)  # decode each video and image once, to find damaged frames
    accept_cut: bool = added(False)  # read videos that are shorter than they state


_checks: ContextVar[VideoChecks | None] = ContextVar("video_checks", default=None)


def video_checks() -> VideoChecks:
    """Return the settings of the running stage."""
    return _checks.get() or VideoChecks()


@contextmanager
def check_videos(checks: VideoChecks) -> Iterator[None]:
    """Let `video_checks` return ``checks`` within the block."""
    token = _checks.set(checks)
    try:
        yield
    finally:
        _checks.reset(token)
