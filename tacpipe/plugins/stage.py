"""Declare a stage: a typed function with a version, whose signature states what it reads.

The first parameter is ``params``, a frozen dataclass or a union of several (`tacpipe.plugins.params`). Each further one
states by its annotation what the stage reads:

=================  ==================================================================================================
``Recording``      one recording at a time; the stage is run, keyed and stored for each recording alone
``Dataset``        all recordings at once; an argument named ``train``, ``val`` or ``test`` holds that role alone, and
                   may be empty if it is annotated ``Dataset | None``; ``originals`` are the recordings as they were
                   given, before they went through the stages that ``first`` names
``Datasets``       several datasets side by side, as a tuple
``Model``          a trained model: a `Dataset` whose ``files`` hold weights and configuration; ``init`` may be left out
``Fitted``         the files that the stage's ``fit`` made of the training recordings
``Parts``          what the stage's ``part`` gave for each recording, as a `Dataset`
``RecordingName``  the name of the one recording; part of its key, so only stages that need it take it
``Files``          the files of one recording of a source; the stage's ``discover`` finds them
``Values``         what ``discover`` gave for one recording beside its files, as labels; part of its key
``Shared``         files that the recordings of a run share, each made once; ``Shared | None``, since there may be no run
``Trial``          the number of one recording to simulate, from 0 to ``params.trials``
``Roles``          roles of recordings, (recording, fold) to role, empty without the option: an argument ``extend`` holds
                   those of the older split that ``--extend`` names, ``split`` those of one fold of ``--split``
``Workspace``      a folder that survives an interruption, for checkpoints
=================  ==================================================================================================

Annotations are read as text, so a stage module needs to import nothing for them but under ``TYPE_CHECKING``.

`Requirements` describe what recordings must contain for a task, by quantity and unit.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any, Generic, ParamSpec, Protocol, TypeAlias, TypeVar, cast

from tacpipe.errors import TacpipeError

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.io.files import Draft

ROLES = ("train", "val", "calibration", "test")
ORIGINALS = "originals"
Attribute = str | int | float | bool | None
Files = Mapping[str, Path]  # name within the source, path to read
Values = Mapping[str, Any]  # JSON values by name
RecordingName = str
Fitted = Mapping[str, bytes]  # file name, content
Trial = int
Roles = Mapping[tuple[str, int], str]
Workspace = Path


class Shared(Protocol):
    """Files that the recordings of a run share; they are removed with its end."""

    def file(self, content_key: Any, make: Callable[[Draft], None]) -> Path:
        """Return the file that ``make`` wrote for the JSON value ``content_key``, now or earlier in any process."""


P = ParamSpec("P")
R = TypeVar("R", covariant=True)
ALL = ("*",)  # Value of ``reads`` for every attribute
_KINDS = (
    *("Recording", "Dataset", "Datasets", "Model", "Fitted", "Parts", "RecordingName"),
    *("Files", "Values", "Shared", "Trial", "Roles", "Workspace"),
)


@dataclass(frozen=True)
class RecordingOutput:
    """Result of a stage for one recording: a table, or one table per stream, attributes to add, and notes for the user.

    A stream that memory need not hold is a ``pyarrow.RecordBatchReader``: its batches are stored as they come, to the bytes
    of the table that they make. What is raised on the way is an error of the recording.

    A note is a sentence about a result that is valid but probably not what was wanted. Commands print it as a warning, on
    a cache hit too; it is kept in the record and is part of no key or digest.
    """

    tables: pa.Table | pa.RecordBatchReader | Mapping[str, pa.Table | pa.RecordBatchReader]
    attributes: Mapping[str, Attribute] = field(default_factory=dict)
    notes: Sequence[str] = ()

    @property
    def streams(self) -> dict[str, pa.Table | pa.RecordBatchReader]:
        """The tables by stream name; a recording of one table has the name ``""``."""
        return dict(self.tables) if isinstance(self.tables, Mapping) else {"": self.tables}


@dataclass(frozen=True)
class Source:
    """Files of one recording, as ``discover`` returns them, and other values that the stage needs, such as labels."""

    files: Files
    values: Values = field(default_factory=dict)


Discover = Callable[[Any, Path], Mapping[str, Mapping[str, Path] | Source]]
# Maps params and a source to a function. That function maps the path of a file in the source to the reason why no
# recording is read from it, "" for a file that is read in another way, as labels are.
WhyUnread = Callable[[Any, Path], Callable[[str], str]]
First = Callable[[Any], Mapping[str, Mapping[str, Any]]]  # Maps params to stages by name, each with its own params


@dataclass(frozen=True)
class Result:
    """Result of a stage over whole datasets: recordings, files or both, and notes for the user (as in `RecordingOutput`).

    Files are taken one by one, so a mapping that makes each when it is asked for holds one in memory. Those of ``written``
    memory need not hold: each is a function that writes the file, once, to what it is given.
    """

    recordings: Mapping[str, RecordingOutput] = field(default_factory=dict)
    files: Mapping[str, bytes] = field(default_factory=dict)
    notes: Sequence[str] = ()
    written: Mapping[str, Callable[[Any], object]] = field(default_factory=dict)


@dataclass(frozen=True)
class Stage(Generic[P, R]):
    """A function with a version; calling it calls the function, with the function's own signature and result type."""

    function: Callable[P, R]
    version: int
    # Attributes that the function reads; None: no attribute of a Recording, all of a Dataset
    reads: tuple[str, ...] | None = None
    fit: AnyStage | None = None  # makes what a ``Fitted`` argument holds
    part: AnyStage | None = None  # runs on each recording; its files are files of the result, its tables are ``Parts``
    first: First | None = None  # stages that the recordings go through before, as the params ask
    originals: Callable[[Any], str] | None = None  # folder of the result for the shards that were given; empty: none
    discover: Discover | None = None
    headline: str | None = None  # the file of the result that holds its headlines, which the command prints
    preview: Callable[[Any, Path], str] | None = None  # Describes what would be read of a source (--dry-run)
    guess: Callable[[Path], str] | None = None  # Returns a first layout file for a source (--guess)
    why_unread: WhyUnread | None = None
    requirements: Requirements | None = None  # Requirements on recordings to train a task (--requirements)
    # Returns True if recordings are read unchanged, without the stages that precede the model's training
    as_given: Callable[[Any], bool] | None = None

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Return what the function returns, for the streams that its params select: no store is involved."""
        params: Any = args[0] if args else kwargs.get("params")
        if not hasattr(params, "narrow"):  # a `StreamSelection`
            return self.function(*args, **kwargs)
        bound = inspect.signature(self.function).bind(*args, **kwargs)
        if name := self.argument("Recording"):
            bound.arguments[name] = params.narrow(bound.arguments[name])
        output = self.function(*bound.args, **bound.kwargs)
        return cast("R", params.narrow_output(output)) if self.source else output

    @functools.cached_property
    def arguments(self) -> dict[str, str]:
        """The stage's arguments after ``params``, and the kind of each."""
        kinds = {}
        for name, parameter in list(inspect.signature(self.function).parameters.items())[1:]:
            kind = _text(parameter.annotation).removesuffix(" | None").rpartition(".")[2]
            if kind not in _KINDS:
                raise TacpipeError(
                    f"Stage {self.function.__name__} annotates {name} as {kind}; known are {', '.join(_KINDS)}."
                )
            kinds[name] = kind
        return kinds

    def argument(self, kind: str) -> str | None:
        """Return the name of the argument of this kind, or None."""
        return next((name for name, argument_kind in self.arguments.items() if argument_kind == kind), None)

    def optional(self, name: str) -> bool:
        """Return whether the argument ``name`` may be left out."""
        return _text(inspect.signature(self.function).parameters[name].annotation).endswith(" | None")

    @functools.cached_property
    def params(self) -> Any:
        """The dataclass of the first argument, or a union of dataclasses; `params.kinds` gives each."""
        function: Any = self.function
        annotation: Any = next(iter(inspect.signature(function).parameters.values())).annotation
        return function.__globals__[annotation] if isinstance(annotation, str) else annotation

    @property
    def reads_model(self) -> bool:
        """Return whether the stage works with a trained model; an optional first model (``init``) does not count."""
        return any(kind == "Model" and name != "init" for name, kind in self.arguments.items())

    @property
    def mapped(self) -> bool:
        """Return whether the stage works recording by recording."""
        return any(kind in ("Recording", "Files", "Trial") for kind in self.arguments.values())

    @property
    def source(self) -> bool:
        """Return whether the stage's result cannot be recomputed from the store."""
        return "Files" in self.arguments.values()

    @property
    def needs_split(self) -> bool:
        """Return whether the stage distinguishes training recordings from others."""
        return self.fit is not None or any(name in ROLES for name in self.arguments)

    @property
    def reads_split(self) -> bool:
        """Return whether ``--split`` and ``--fold`` may be given."""
        return self.needs_split or self.reads_model or "split" in self.arguments

    @property
    def tracked(self) -> bool:
        """Return whether trackers can follow the stage: it trains in a workspace, or its result has headlines."""
        return self.trains or self.headline is not None

    @property
    def trains(self) -> bool:
        """Return whether the stage or its fit trains networks: it has a workspace for their checkpoints."""
        return any(stage is not None and stage.argument("Workspace") is not None for stage in (self, self.fit))


AnyStage: TypeAlias = Stage[..., Any]


def _text(annotation: Any) -> str:
    """Return an annotation as it is written, ``Dataset | None``, whether or not Python has evaluated it.

    >>> _text("tacpipe.Dataset | None"), _text(Path)
    ('tacpipe.Dataset | None', 'Path')
    """
    return annotation.__name__ if isinstance(annotation, type) else str(annotation).strip("'\"")


def stage(
    *,
    version: int,
    reads: tuple[str, ...] | None = None,
    fit: AnyStage | None = None,
    part: AnyStage | None = None,
    first: First | None = None,
    originals: Callable[[Any], str] | None = None,
    discover: Discover | None = None,
    headline: str | None = None,
    preview: Callable[[Any, Path], str] | None = None,
    guess: Callable[[Path], str] | None = None,
    why_unread: WhyUnread | None = None,
    requirements: Requirements | None = None,
    as_given: Callable[[Any], bool] | None = None,
) -> Callable[[Callable[P, R]], Stage[P, R]]:
    """Declare the decorated function a stage, whose signature it keeps. Raise ``version`` whenever its result changes.

    ``headline`` names the file of its result (`tacpipe.metrics.headline`) that the command prints as a table.
    ``part`` is keyed recording by recording, with the same params; its files become files of the result, and an argument
    ``Parts`` holds its tables. ``first`` names stages that the recordings go through before, with params of their own.
    ``preview`` returns what ``discover`` and the stage would read of a source, in words; ``guess`` a first layout of one.
    ``why_unread`` explains which files of a source are left out.
    ``requirements`` describe what recordings must hold. ``as_given`` states by the params whether recordings are not taken
    through the stages of a ``Model`` first.
    """
    return lambda function: Stage(
        function,
        version,
        reads,
        fit,
        part,
        first,
        originals,
        discover,
        headline,
        preview,
        guess,
        why_unread,
        requirements,
        as_given,
    )


REQUIREMENT_WIDTH = 110  # Characters per line
ANY_QUANTITY = "any"


@dataclass(frozen=True)
class Channels:
    """Columns of one quantity that a task reads."""

    quantity: str
    units: tuple[str, ...]  # none: any one unit
    description: str  # how many, of which components or streams
    without: str = ""  # Consequence of their absence; empty: they are required
    stream: str = ""  # the stream that they are columns of, where the task looks for it by name


@dataclass(frozen=True)
class Label:
    """A label of recordings that a task reads."""

    name: str
    description: str
    without: str = ""


@dataclass(frozen=True)
class Requirements:
    """Requirements of a task on its recordings, and the stages that prepare them."""

    task: str
    stages: Sequence[str]  # Stages whose output the task reads, in order
    optional_stages: Sequence[str]
    roles: str  # Roles that the split must have
    channels: Sequence[Channels]
    labels: Sequence[Label] = ()

    @property
    def needed(self) -> tuple[str, ...]:
        """The quantities without which a recording is refused."""
        return tuple(channel.quantity for channel in self.channels if not channel.without)

    def to_text(self) -> str:
        """Return all of it as lines."""
        chain = ", then ".join(f"tacpipe {stage}" for stage in self.stages)
        lines = [f"tacpipe train {self.task} reads the output of", f"  {chain}"]
        lines += [f"  (optional: {stage})" for stage in self.optional_stages]
        lines += ["", "roles of the split", *_wrapped(self.roles, "  "), ""]
        lines += ["channels: found by the quantity and unit of a column, in any stream unless one is named"]
        for channel in self.channels:
            place = f", stream {channel.stream}" if channel.stream else ""
            head = f"  {channel.quantity} [{' or '.join(channel.units) or 'any unit'}]{place}: "
            lines += _wrapped(f"{channel.description}. {_need(channel.without)}", head)
        if self.labels:
            lines += ["", "labels of recordings"]
            lines += [
                line
                for label in self.labels
                for line in _wrapped(f"{label.description}. {_need(label.without)}", f"  {label.name}: ")
            ]
        lines += [
            "",
            "A layout file sets them: quantity, unit, component and {taxel} in [streams.NAME] columns, labels in [[labels]]",
            "or [attributes]. `tacpipe label DATASET --from TABLE` sets labels afterwards.",
        ]
        return "\n".join(lines)


def _need(without: str) -> str:
    return f"Optional: {without}." if without else "Needed."


def _wrapped(text: str, head: str) -> list[str]:
    return wrap(text, REQUIREMENT_WIDTH, initial_indent=head, subsequent_indent="      " if head.strip() else head)
