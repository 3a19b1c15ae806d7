"""An exception that a stage's own code raised, reported with the frames of that code alone."""

from __future__ import annotations

import os
import traceback
from typing import Any

ALL_FRAMES = "TACPIPE_TRACEBACK"  # environment variable: set, the whole traceback is printed
_NAME = "tacpipe_failure"  # attribute of the exception, which travels with it from a worker process


def attach(error: BaseException, stage: str, recording: str, outer: tuple[str, ...]) -> None:
    """Note in ``error`` which stage raised it, and its frames without the first ones, which lie in the files ``outer``."""
    described = traceback.TracebackException.from_exception(error)
    frames = list(described.stack)
    while frames and frames[0].filename in outer:
        frames.pop(0)
    described.stack = traceback.StackSummary.from_list(frames)
    setattr(error, _NAME, {"stage": stage, "recording": recording, "frames": "".join(described.format())})


def text(error: BaseException) -> str | None:
    """Return the message for an exception that a stage raised; None for other exceptions and if all frames are requested."""
    failure: dict[str, Any] | None = getattr(error, _NAME, None)
    if failure is None or os.environ.get(ALL_FRAMES):
        return None
    place = f" on recording {failure['recording']}" if failure["recording"] else ""
    return (
        f"The code of stage {failure['stage']} raised {type(error).__name__}{place}:\n{failure['frames'].rstrip()}\n"
        f"What was finished is kept in the store. Set {ALL_FRAMES}=1 to see the frames of tacpipe too."
    )


def line(error: BaseException) -> str:
    """Return in one line what was raised and where: the file and line of the innermost frame, or of the syntax error."""
    described = f"{type(error).__name__}: {error}"
    if isinstance(error, SyntaxError):  # Its text ends with the file's name and line
        return f"{type(error).__name__}: {error.msg}, in {error.filename}, line {error.lineno}."
    frames = traceback.extract_tb(error.__traceback__)
    return f"{described}, in {frames[-1].filename}, line {frames[-1].lineno}." if frames else f"{described}."
