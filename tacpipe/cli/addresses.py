"""Refuse addresses, such as ``s3://bucket/x``, in all arguments and options of commands that are paths."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import typer

from tacpipe.io.files import local


def refuse(program: typer.Typer) -> None:
    """Have every command of ``program`` refuse addresses in all its arguments and options that are paths."""
    for group in program.registered_groups:
        if group.typer_instance is not None:
            refuse(group.typer_instance)
    for command in program.registered_commands:
        if command.callback is not None:
            command.callback = _checked(command.callback)


def _checked(callback: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(callback)
    def call(*args: Any, **options: Any) -> Any:
        for value in options.values():
            for path in value if isinstance(value, list | tuple) else [value]:
                if isinstance(path, Path):
                    local(path)
        return callback(*args, **options)

    return call
