"""Places that a command is given: paths of this machine. An address such as ``s3://bucket/x`` is none of them."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tacpipe.errors import UsageError

if TYPE_CHECKING:
    import typer

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


def expect_local(program: typer.Typer) -> None:
    """Have every command of ``program`` refuse addresses in all its arguments and options that are paths."""
    for group in program.registered_groups:
        if group.typer_instance is not None:
            expect_local(group.typer_instance)
    for command in program.registered_commands:
        if command.callback is not None:
            command.callback = _checked(command.callback)


def _checked(callback: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(callback)
    def call(*args: Any, **given: Any) -> Any:
        for value in given.values():
            for path in value if isinstance(value, list | tuple) else [value]:
                if isinstance(path, Path):
                    local(path)
        return callback(*args, **given)

    return call
