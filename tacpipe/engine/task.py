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
    name: str  # Name of the stage
    identity: Mapping[str, Any]
    recording: str = ""
    files: Mapping[str, str] | None = None  # Files of a published source: name to path
    dataset_dirs: tuple[str, ...] = ()  # dataset directories whose shards can be adopted
    replace: bool = False  # the old record names objects that are gone
    dry: bool = False  # compute and compare, store nothing
    rerun: bool = False  # compute although a result is stored
    device: Device = AUTO  # the device that networks are trained on
    run: str = ""  # the lease of the run that it is part of


@dataclass(frozen=True)
class Done:
    """Outcome of a task: a record, or the error of the recording."""

    recording: str
    record: Mapping[str, Any] | None
    error: str = ""
    exit_code: int = 0
    is_new: bool = True  # False if another process was faster
    at_fault: bool = True  # the recording is, and not the disk, a damaged input or another process
