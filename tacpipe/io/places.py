"""Places that a command is given: paths of this machine. An address such as ``s3://bucket/x`` is none of them."""

from __future__ import annotations

import re
from pathlib import Path

from tacpipe.errors import UsageError

_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:/")  # one slash: Path("s3://bucket/x") keeps no second one


def local(path: Path | str) -> Path:
    """Return ``path``. Raises `UsageError` for an address: a folder of that name would be made here instead.

    >>> local("data/recordings")
    PosixPath('data/recordings')
    """
    if _ADDRESS.match(str(path)):
        scheme, _, rest = str(path).partition(":")
        raise UsageError(
            f"{scheme}://{rest.lstrip('/')} is an address, and {scheme}:// is not supported. Give a path of the file system."
        )
    return Path(path)
