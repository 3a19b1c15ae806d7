"""What a stage is: a typed function whose signature is its declaration.

The first parameter is ``params``, a frozen dataclass or a union of several (`tacpipe.plugins.params`). Each further one says
by its annotation what the stage reads:

==============  ==========================================================================================
``Recording``   one recording at a time; the stage is run, keyed and stored for each recording alone
``Dataset``     all recordings at once; an argument named ``train``, ``val`` or ``test`` holds that role alone, and
                may be empty where it is annotated ``Dataset | None``
``Datasets``    several datasets side by side, as a tuple
``Model``       a trained model: a `Dataset` whose ``files`` hold weights and configuration; ``init`` may be left out
``Fitted``      the files that the stage's ``fit`` made of the training recordings
``Files``       the files of one recording of a published source; the stage's ``discover`` finds them
``Trial``       the number of one recording to simulate, from 0 to ``params.trials``
``Roles``       the roles of an older split, (recording, fold) to role; empty unless ``--extend`` names one
``Workspace``   a folder that survives an interruption, for checkpoints
==============  ==========================================================================================

Annotations are read as text, so a stage module needs to import nothing for them but under ``TYPE_CHECKING``.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tacpipe.errors import TacpipeError

if TYPE_CHECKING:
    import pyarrow as pa

ROLES = ("train", "val", "test")
Attribute = str | int | float | bool | None
Files = Mapping[str, Path]  # name within the source, path to read
Fitted = Mapping[str, bytes]  # file name, content
Trial = int
Roles = Mapping[tuple[str, int], str]
Workspace = Path
_KINDS = ("Recording", "Dataset", "Datasets", "Model", "Fitted", "Files", "Trial", "Roles", "Workspace")


@dataclass(frozen=True)
class RecordingOutput:
    """What a stage returns for one recording: a table, or one a stream, attributes to add, and notes for the user.

    A note is a sentence about a result that is valid but probably not what was wanted. Commands print it as a warning, on
    a cache hit too; it is kept in the record and is part of no key or digest.
    """

    tables: pa.Table | Mapping[str, pa.Table]
    attributes: Mapping[str, Attribute] = field(default_factory=dict)
    notes: Sequence[str] = ()

    @property
    def streams(self) -> dict[str, pa.Table]:
        """The tables by stream name; a recording of one table has the name ``""``."""
        return dict(self.tables) if isinstance(self.tables, Mapping) else {"": self.tables}


@dataclass(frozen=True)
class Result:
    """What a stage over whole datasets returns: recordings, files or both, and notes for the user (as `RecordingOutput`)."""

    recordings: Mapping[str, RecordingOutput] = field(default_factory=dict)
    files: Mapping[str, bytes] = field(default_factory=dict)
    notes: Sequence[str] = ()


@dataclass(frozen=True)
class Stage:
    """A function with a version; calling it calls the function."""

    function: Callable[..., Any]
    version: int
    reads: tuple[str, ...] | None = (
        None  # attributes that the function looks at; None: none of a Recording, all of a Dataset
    )
    fit: Stage | None = None  # makes what a ``Fitted`` argument holds
    discover: Callable[[Any, Path], Mapping[str, Mapping[str, Path]]] | None = None
    headline: str | None = None  # the file of the result that holds its headlines, which the command prints

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Return what the function returns: no store is involved."""
        return self.function(*args, **kwargs)

    @functools.cached_property
    def arguments(self) -> dict[str, str]:
        """The stage's arguments after ``params``, and the kind of each."""
        found = {}
        for name, parameter in list(inspect.signature(self.function).parameters.items())[1:]:
            kind = str(parameter.annotation).strip("'\"").removesuffix(" | None")
            if kind not in _KINDS:
                raise TacpipeError(
                    f"Stage {self.function.__name__} annotates {name} as {kind}; known are {', '.join(_KINDS)}."
                )
            found[name] = kind
        return found

    def argument(self, kind: str) -> str | None:
        """The name of the argument of this kind, or None."""
        return next((name for name, found in self.arguments.items() if found == kind), None)

    def optional(self, name: str) -> bool:
        """Return whether the argument ``name`` may be left out."""
        return str(inspect.signature(self.function).parameters[name].annotation).strip("'\"").endswith(" | None")

    @property
    def params(self) -> Any:
        """The dataclass of the first argument, or a union of dataclasses; `params.kinds` gives each."""
        name = next(iter(inspect.signature(self.function).parameters.values())).annotation
        return self.function.__globals__[name] if isinstance(name, str) else name

    @property
    def reads_model(self) -> bool:
        """Whether the stage works with a trained model, rather than beginning with one if it is given (``init``)."""
        return any(kind == "Model" and name != "init" for name, kind in self.arguments.items())

    @property
    def mapped(self) -> bool:
        """Whether the stage works recording by recording."""
        return any(kind in ("Recording", "Files", "Trial") for kind in self.arguments.values())

    @property
    def source(self) -> bool:
        """Whether what the stage returns cannot be recomputed from the store."""
        return "Files" in self.arguments.values()

    @property
    def needs_split(self) -> bool:
        """Whether the stage distinguishes training recordings from others."""
        return self.fit is not None or any(name in ROLES for name in self.arguments)


def stage(
    *,
    version: int,
    reads: tuple[str, ...] | None = None,
    fit: Stage | None = None,
    discover: Callable[[Any, Path], Mapping[str, Mapping[str, Path]]] | None = None,
    headline: str | None = None,
) -> Callable[[Callable[..., Any]], Stage]:
    """Declare the decorated function a stage. Raise ``version`` whenever its result changes.

    ``headline`` names the file of its result (`tacpipe.metrics.headline`) that the command prints as a table.
    """
    return lambda function: Stage(function, version, reads, fit, discover, headline)
