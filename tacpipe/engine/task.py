"""One key to make, and what became of it: what goes to a worker process and comes back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from tacpipe.training.devices import AUTO, Device


@dataclass(frozen=True)
class Task:
    """One key to make: all that a worker process needs."""

    store: str  # its path or address
    name: str  # of the stage
    identity: Mapping[str, Any]
    recording: str = ""
    files: Mapping[str, str] | None = None  # of a published source: name to path
    beside: tuple[str, ...] = ()  # dataset directories whose shards can be adopted
    replace: bool = False  # the old record names objects that are gone
    dry: bool = False  # compute and compare, store nothing
    rerun: bool = False  # compute although a result is stored
    device: Device = AUTO  # the device that networks are trained on
    run: str = ""  # the lease of the run that it is part of


@dataclass(frozen=True)
class Done:
    """What became of a task: a record, or what was wrong with the recording."""

    recording: str
    record: Mapping[str, Any] | None
    error: str = ""
    exit_code: int = 0
    made: bool = True  # False if another process was faster
    at_fault: bool = True  # the recording is, and not the disk, a damaged input or another process
