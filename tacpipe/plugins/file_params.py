"""Make the content of files that params name part of the key of a result."""

from __future__ import annotations

from pathlib import Path

from tacpipe.errors import UsageError
from tacpipe.io.hashing import file_digest


def pin_file(name: str, path: str, sha256: str) -> str:
    """Return the sha256 of the file ``path`` of the param ``name``, "" without a path.

    Raises `UsageError` if the file cannot be read, or if its sha256 differs from ``sha256``, unless this is "".
    """
    if not path:
        return sha256
    try:
        digest = file_digest(Path(path)).removeprefix("sha256:")
    except OSError as error:
        raise UsageError(
            f"The {name} {path} cannot be read: {error.strerror}. Give a file of this computer."
        ) from error
    if sha256 not in ("", digest):
        raise UsageError(
            f"{path} has the sha256 {digest}, and {name}_sha256 states {sha256}. Give the file that was used before, or "
            f"leave {name}_sha256 out."
        )
    return digest
