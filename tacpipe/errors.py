"""Define errors whose messages are sentences, and the exit code of each."""

from __future__ import annotations

import re

from tacpipe import printable

MAX_WORD_LENGTH = 250  # letters: no path or name that a person gave is longer
DONE, FAILED, USAGE, WOULD_CHANGE, DAMAGED, DEVICE, LOCKED, INTERRUPTED = 0, 1, 2, 3, 4, 5, 6, 130


class TacpipeError(Exception):
    """A mistake that its reader can fix: printed without traceback."""

    exit_code = FAILED

    def __str__(self) -> str:
        """Return the sentence; untrusted text in it is cut to a line, and its control characters are escaped."""
        text = super().__str__()
        if len(text) > MAX_WORD_LENGTH:
            text = re.sub(rf"\S{{{MAX_WORD_LENGTH},}}", lambda word: f"{word[0][:100]}…{word[0][-100:]}", text)
        return printable.lines(text.split("\n"))


class UsageError(TacpipeError):
    """The command or its params are wrong."""

    exit_code = USAGE


class WouldChangeError(TacpipeError):
    """``--check`` found that the stored result is not up to date."""

    exit_code = WOULD_CHANGE


class MissingModuleError(TacpipeError, ImportError):
    """A module of an optional part, or one that a plug-in needs, is not installed."""


class StorageError(TacpipeError):
    """The disk or the store failed, whatever was to be stored."""


class DeniedError(StorageError):
    """The permissions of a file or folder exclude this user. ``owner`` is the user id of its owner."""

    def __init__(self, message: str, owner: int = -1) -> None:
        super().__init__(message)
        self.owner = owner


class ShortageError(StorageError):
    """The computer ran out of memory, threads or processes, whatever was worked on."""


class DamagedError(TacpipeError):
    """Stored bytes were damaged and cannot be recomputed."""

    exit_code = DAMAGED


class LockedError(TacpipeError):
    """Another process still has the lock when the wait for it times out."""

    exit_code = LOCKED


class DeviceError(TacpipeError):
    """A device is missing, busy, silent, lost, or speaks another protocol."""

    exit_code = DEVICE


class ResultWarning(UserWarning):
    """A result is valid but probably not the intended one, or lacks recordings that could not be read."""


def is_input_error(error: TacpipeError) -> bool:
    """Return whether the input is at fault, rather than the command, the disk, the computer or the installation."""
    return error.exit_code == FAILED and not isinstance(error, StorageError | MissingModuleError)
