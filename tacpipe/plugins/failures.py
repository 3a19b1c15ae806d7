"""Explain exceptions that nothing anticipated: those of readers as errors of their files, those of stages with frames."""

from __future__ import annotations

import os
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TypedDict

from tacpipe.errors import TacpipeError
from tacpipe.io import memory
from tacpipe.plugins import extras
from tacpipe.printable import plain

ALL_FRAMES = "TACPIPE_TRACEBACK"  # environment variable: if set, the full traceback is printed
DEFECT = "This is a defect of tacpipe: report it with the traceback"
MAX_PATHS = 3  # maximum number of paths that an error names
_NAME = "tacpipe_failure"  # attribute of the exception, which is pickled with it in a worker process


class StageFailure(TypedDict):
    """The stage that raised an exception."""

    stage: str
    recording: str
    frames: str  # frames of the traceback
    is_own: bool  # True if tacpipe's own code raised it


@contextmanager
def naming_source(paths: Iterable[object]) -> Iterator[None]:
    """Raise any exception of a reader in the block as a `TacpipeError` that names the files it reads.

    Errors with a message of their own pass unchanged: `TacpipeError`, a module that cannot be imported, exhausted
    memory, and errors of the system. If `ALL_FRAMES` is set, all exceptions do.
    """
    try:
        yield
    except Exception as error:
        is_system_error = isinstance(error, OSError) and error.errno is not None
        is_explained = isinstance(error, TacpipeError | ImportError) or is_system_error or memory.shortage(error)
        if is_explained or os.environ.get(ALL_FRAMES):
            raise
        names = list(dict.fromkeys(map(str, paths)))
        source = ", ".join(names[:MAX_PATHS])
        source += f" and {len(names) - MAX_PATHS} more" if len(names) > MAX_PATHS else ""
        text = " ".join(str(error).strip().splitlines()[:1])
        reason = f"{type(error).__name__}: {plain(text, 200)}".removesuffix(": ").removesuffix(".")
        remedy = "Copy it again from its source, or leave it out"
        if _is_own(error):
            remedy = f"{DEFECT} that {ALL_FRAMES}=1 shows, and leave the recording out until then"
        raise TacpipeError(f"{source} cannot be read: {reason}. {remedy}.") from error


def _is_own(error: BaseException) -> bool:
    """Return whether tacpipe's code raised an exception, rather than a library or a plug-in that it called."""
    frames = list(traceback.walk_tb(error.__traceback__))
    return bool(frames) and frames[-1][0].f_globals.get("__name__", "").partition(".")[0] in extras.OWN


def attach_stage(error: BaseException, stage: str, recording: str, outer: tuple[str, ...]) -> None:
    """Add its stage and recording to ``error``, and its traceback without the leading frames from the files ``outer``."""
    described = traceback.TracebackException.from_exception(error)
    frames = list(described.stack)
    while frames and frames[0].filename in outer:
        frames.pop(0)
    described.stack = traceback.StackSummary.from_list(frames)
    text = "".join(described.format())
    setattr(error, _NAME, {"stage": stage, "recording": recording, "frames": text, "is_own": _is_own(error)})


def failure_text(error: BaseException) -> str | None:
    """Return the message for an exception that a stage raised; None for other exceptions and if all frames are requested."""
    failure: StageFailure | None = getattr(error, _NAME, None)
    if failure is None or os.environ.get(ALL_FRAMES):
        return None
    on_recording = f" on recording {failure['recording']}" if failure["recording"] else ""
    defect = f"{DEFECT}. " if failure["is_own"] else ""
    return (
        f"The code of stage {failure['stage']} raised {type(error).__name__}{on_recording}:\n{failure['frames'].rstrip()}\n"
        f"{defect}What was finished is kept in the store. Set {ALL_FRAMES}=1 to see the frames of tacpipe too."
    )


def failure_line(error: BaseException) -> str:
    """Return a line with the exception and its location: file and line of the innermost frame, or of the syntax error."""
    described = f"{type(error).__name__}: {error}"
    if isinstance(error, SyntaxError):  # its text already ends with file name and line
        return f"{type(error).__name__}: {error.msg}, in {error.filename}, line {error.lineno}."
    frames = traceback.extract_tb(error.__traceback__)
    return f"{described}, in {frames[-1].filename}, line {frames[-1].lineno}." if frames else f"{described}."
