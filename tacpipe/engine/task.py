"""One key to make, and what became of it: what goes to a worker process and comes back."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from tacpipe.io.hashing import canonical
from tacpipe.training.devices import Compute


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
    compute: Compute = field(default_factory=Compute)  # what networks are trained on
    run: str = ""  # the lease of the run that it is part of

    def to_text(self) -> str:
        """Return what `task_of` reads."""
        return canonical(
            {**vars(self), "compute": asdict(self.compute)}
        ).decode()  # an identity may name all recordings


def task_of(text: str) -> Task:
    """Return the task that `Task.to_text` wrote."""
    given = json.loads(text)
    return Task(**{**given, "beside": tuple(given["beside"]), "compute": Compute(**given["compute"])})


@dataclass(frozen=True)
class Done:
    """What became of a task: a record, or what was wrong with the recording."""

    recording: str
    record: Mapping[str, Any] | None
    error: str = ""
    exit_code: int = 0
    made: bool = True  # False if another process was faster
    at_fault: bool = True  # the recording is, and not the disk, a damaged input or another process
