"""Objects that lie in a dataset's directory alone, as after a copy of a dataset without its store: verified, then stored."""

from __future__ import annotations

from pathlib import Path

from tacpipe.errors import StorageError
from tacpipe.io import regular
from tacpipe.io.files import unread
from tacpipe.io.hashing import bytes_digest


def verified_copy(name: str, path: str, directories: tuple[str, ...], size: int | None = None) -> bytes | None:
    """Return the object ``name`` from ``path`` in one of the dataset directories, verified; None if none has it.

    It may be a link, as DVC and git-annex make them: its digest is what counts. ``size`` is what its manifest declares.
    Raises `StorageError` where none has it and one may: the system failed to read what lies there, or memory is short.
    """
    failed: StorageError | None = None
    for directory in directories:
        file = Path(directory) / path
        try:
            content = regular.content(file, size)
        except (FileNotFoundError, NotADirectoryError, regular.IrregularError):
            continue
        except OSError as error:
            failed = unread(file, error)
            continue
        except StorageError as error:
            failed = error
            continue
        if bytes_digest(content) == name:
            return content
    if failed is not None:
        raise failed
    return None
