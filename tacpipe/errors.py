"""What can go wrong, as sentences, and the exit code each means."""

from __future__ import annotations

DONE, FAILED, USAGE, WOULD_CHANGE, DAMAGED, DEVICE, LOCKED, INTERRUPTED = 0, 1, 2, 3, 4, 5, 6, 130


class TacpipeError(Exception):
    """A mistake that its reader can mend: printed without traceback."""

    exit_code = FAILED


class UsageError(TacpipeError):
    """The command or its params are off."""

    exit_code = USAGE


class WouldChangeError(TacpipeError):
    """``--check`` found that the stored result is not up to date."""

    exit_code = WOULD_CHANGE


class DamagedError(TacpipeError):
    """Stored bytes are not what they were, and cannot be made again."""

    exit_code = DAMAGED


class LockedError(TacpipeError):
    """Another process holds what this one waited for."""

    exit_code = LOCKED


class DeviceError(TacpipeError):
    """A device is missing, busy, silent, lost, or speaks another protocol."""

    exit_code = DEVICE
