"""Turn the errors that libraries raise for damaged bytes into sentences with the name of the file."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from tacpipe.errors import TacpipeError
from tacpipe.io import regular
from tacpipe.printable import plain

MAX_CHARACTERS = 200  # maximum length of a library's reason in a sentence


@contextlib.contextmanager
def explaining(
    errors: type[Exception] | tuple[type[Exception], ...], before: str, after: str = ".", *, path: Path | None = None
) -> Iterator[None]:
    """Raise ``errors`` in the block as a `TacpipeError`: the reason that the library gives, between two texts.

    With ``path``, errors of the system are raised as `regular.failing` does.
    """
    try:
        yield
    except errors as error:
        if path is not None and isinstance(error, OSError) and error.errno is not None:
            with regular.failing(path):
                raise
        reason = plain(" ".join(str(error).split()), MAX_CHARACTERS)
        raise TacpipeError(f"{before}{reason}{after}") from error
