"""Declare stages: typed functions with a version, whose signature determines their inputs.

The first parameter is ``params``, a frozen dataclass or a union of several (`tacpipe.plugins.params`). The annotation
of each further parameter determines what the stage reads:

=================  ==================================================================================================
``Recording``      one recording; the stage is run, keyed and stored for each recording separately
``Dataset``        all recordings; an argument named ``train``, ``val`` or ``test`` contains only that role, and may be
                   empty if it is annotated ``Dataset | None``; ``originals`` are the recordings as they were given,
                   before the stages in ``first``
``Datasets``       several datasets, as a tuple
``Rows``           the rows that were read for each of the ``Datasets`` and those that it comes from, by stage
``Model``          a trained model: a `Dataset` whose ``files`` contain weights and configuration; ``init`` is optional
``Fitted``         the files that the stage's ``fit`` computed from the training recordings
``Parts``          the results of the stage's ``part`` for each recording, as a `Dataset`
``RecordingName``  the name of the recording; it becomes part of the key, so only stages that need it have it
``Files``          the files of one recording of a source, found by the stage's ``discover``
``Values``         further values from ``discover`` for one recording, such as labels; part of its key
``Shared``         files shared by the recordings of a run, each created once; ``Shared | None``, as there may be no run
``Trial``          the index of one recording to simulate, from 0 to ``params.trials``
``Roles``          role by (recording, fold), empty without the option: ``extend`` contains those of the older split given
                   by ``--extend``, ``split`` those of one fold of ``--split``
``Workspace``      a folder for checkpoints that survives an interruption
=================  ==================================================================================================

Annotations are read as text, so a stage module imports nothing for them outside ``TYPE_CHECKING``.

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
from tacpipe.io import Json
from tacpipe.plugins.rows import StreamRows

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.io.files import Draft

ROLES = ("train", "val", "calibration", "test")
ORIGINALS = "originals"
Attribute = str | int | float | bool | None
Files = Mapping[str, Path]  # path by name in the source
Values = Json  # values of a recording from ``discover``, and other JSON values by name
ParamValue = str | float | bool | None | Sequence[Any] | Json
StoredParams = Mapping[str, ParamValue]  # params of a stage in keys, manifests and models
Presets = Mapping[str, Values]  # named sets of params
RecordingName = str
Fitted = Mapping[str, bytes]  # content by file name
Trial = int
Roles = Mapping[tuple[str, int], str]
Workspace = Path


class Shared(Protocol):
    """Files shared by the recordings of a run, removed when the run ends."""

    def file(self, content_key: Any, make: Callable[[Draft], None]) -> Path:
        """Return the file that ``make`` wrote for the JSON value ``content_key``, in this or an earlier process."""


P = ParamSpec("P")
R = TypeVar("R", covariant=True)
ALL = ("*",)  # value of ``reads`` for all attributes
_KINDS = (
    *("Recording", "Dataset", "Datasets", "Rows", "Model", "Fitted", "Parts", "RecordingName"),
    *("Files", "Values", "Shared", "Trial", "Roles", "Workspace"),
)


@dataclass(frozen=True)
class RecordingOutput:
    """Result of a stage for one recording: a table, or one table per stream, new attributes, and notes for the user.

    A stream that does not fit in memory is a ``pyarrow.RecordBatchReader``. Its batches are stored as they arrive, with
    the same bytes as the complete table. Errors raised while reading it are errors of the recording.

    A note is a sentence about a result that is valid but probably not intended. Commands print it as a warning, also on
    a cache hit. It is stored in the record and is not part of a key or digest.

    ``rows`` account for every row that the stage read, by stream. Counts and notes are read after the batches, which may
    add to them. A reader of files gives ``{}``, and `tacpipe.plugins.rows.drop_rows` states what it dropped. With None, a
    stream that has as many rows in the result is used, and others are not counted.
    """

    tables: pa.Table | pa.RecordBatchReader | Mapping[str, pa.Table | pa.RecordBatchReader]
    attributes: Mapping[str, Attribute] = field(default_factory=dict)
    notes: Sequence[str] = ()
    rows: StreamRows | None = None

    @property
    def streams(self) -> dict[str, pa.Table | pa.RecordBatchReader]:
        """The tables by stream name; a recording of a single table has the name ``""``."""
        return dict(self.tables) if isinstance(self.tables, Mapping) else {"": self.tables}


@dataclass(frozen=True)
class Source:
    """The files of one recording, as returned by ``discover``, and other values for the stage, such as labels."""

    files: Files
    values: Values = field(default_factory=dict)


Discover = Callable[[Any, Path], Mapping[str, Mapping[str, Path] | Source]]
# (params, source) -> (path in the source -> reason why it is not read, "" for files used otherwise, such as labels)
WhyUnread = Callable[[Any, Path], Callable[[str], str]]
First = Callable[[Any], Mapping[str, Values]]  # params -> params of preceding stages by name


@dataclass(frozen=True)
class Result:
    """Result of a stage over whole datasets: recordings, files or both, notes and rows (as in `RecordingOutput`).

    Files are read one at a time, so a mapping that creates each file on access keeps only one in memory. ``written``
    contains files that do not fit in memory, as functions that write the file to their argument; each is called once.
    """

    recordings: Mapping[str, RecordingOutput] = field(default_factory=dict)
    files: Mapping[str, bytes] = field(default_factory=dict)
    notes: Sequence[str] = ()
    written: Mapping[str, Callable[[Any], object]] = field(default_factory=dict)
    rows: StreamRows | None = None


@dataclass(frozen=True)
class Stage(Generic[P, R]):
    """A function with a version. Calling it calls the function, with its signature and result type."""

    function: Callable[P, R]
    version: int
    # attributes that the function reads; None for no attribute of a Recording and all of a Dataset
    reads: tuple[str, ...] | None = None
    fit: AnyStage | None = None  # computes the files of a ``Fitted`` argument
    # runs on each recording; its files become files of the result, its tables are ``Parts``
    part: AnyStage | None = None
    first: First | None = None  # preceding stages, depending on the params
    originals: Callable[[Any], str] | None = None  # folder of the result for input shards; empty for none
    discover: Discover | None = None
    headline: str | None = None  # file of the result with its headlines, which the command prints
    preview: Callable[[Any, Path], str] | None = None  # describes what would be read from a source (--dry-run)
    guess: Callable[[Path], str] | None = None  # returns a first layout file for a source (--guess)
    why_unread: WhyUnread | None = None
    requirements: Requirements | None = None  # requirements on recordings for training a task (--requirements)
    # returns whether recordings are read unchanged, without the stages of the model's chain
    as_given: Callable[[Any], bool] | None = None

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Call the function with the streams that its params select, without a store."""
        params: Any = args[0] if args else kwargs.get("params")
        if not hasattr(params, "narrow"):  # only a `StreamSelection` has this method
            return self.function(*args, **kwargs)
        bound = inspect.signature(self.function).bind(*args, **kwargs)
        if name := self.argument("Recording"):
            bound.arguments[name] = params.narrow(bound.arguments[name])
        output = self.function(*bound.args, **bound.kwargs)
        return cast("R", params.narrow_output(output)) if self.source else output

    @functools.cached_property
    def arguments(self) -> dict[str, str]:
        """The kind of each argument after ``params``, by name. Raises `TacpipeError` for an unknown annotation."""
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
        """Return the name of the argument of this kind, or None if there is none."""
        return next((name for name, argument_kind in self.arguments.items() if argument_kind == kind), None)

    def optional(self, name: str) -> bool:
        """Return whether the argument ``name`` is optional."""
        return _text(inspect.signature(self.function).parameters[name].annotation).endswith(" | None")

    @functools.cached_property
    def params(self) -> Any:
        """The dataclass of the first argument, or a union of dataclasses; see `params.kinds`."""
        function: Any = self.function
        annotation: Any = next(iter(inspect.signature(function).parameters.values())).annotation
        return function.__globals__[annotation] if isinstance(annotation, str) else annotation

    @property
    def reads_model(self) -> bool:
        """Whether the stage requires a trained model; an optional initial model (``init``) does not count."""
        return any(kind == "Model" and name != "init" for name, kind in self.arguments.items())

    @property
    def mapped(self) -> bool:
        """Whether the stage works recording by recording."""
        return any(kind in ("Recording", "Files", "Trial") for kind in self.arguments.values())

    @property
    def source(self) -> bool:
        """Whether the stage's result cannot be recomputed from the store."""
        return "Files" in self.arguments.values()

    @property
    def needs_split(self) -> bool:
        """Whether the stage treats training recordings differently from others."""
        return self.fit is not None or any(name in ROLES for name in self.arguments)

    @property
    def reads_split(self) -> bool:
        """Whether the stage accepts ``--split`` and ``--fold``."""
        return self.needs_split or self.reads_model or "split" in self.arguments

    @property
    def tracked(self) -> bool:
        """Whether trackers can follow the stage: it trains in a workspace, or its result has headlines."""
        return self.trains or self.headline is not None

    @property
    def trains(self) -> bool:
        """Whether the stage or its fit trains networks, so that it has a workspace for checkpoints."""
        return any(stage is not None and stage.argument("Workspace") is not None for stage in (self, self.fit))


AnyStage: TypeAlias = Stage[..., Any]


def _text(annotation: Any) -> str:
    """Return an annotation as source text, whether or not Python has evaluated it.

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
    """Return a decorator that makes a function a stage with the same signature.

    Increase ``version`` whenever the stage's result changes. ``headline`` is the file of the result
    (`tacpipe.metrics.headline`) that the command prints as a table. ``part`` is a stage that runs and is cached by
    recording, with the same params; its files become files of the result, and an argument ``Parts`` contains its tables.
    ``first`` returns the preceding stages with their params. ``preview`` describes what ``discover`` and the stage would
    read from a source; ``guess`` returns a first layout for it; ``why_unread`` explains why files of it are not read.
    ``requirements`` describe what recordings must contain. ``as_given`` returns, depending on the params, whether
    recordings skip the stages of a ``Model``.
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


REQUIREMENT_WIDTH = 110  # maximum number of characters per line


@dataclass(frozen=True)
class Channels:
    """Columns of a quantity that a task reads."""

    quantity: str
    units: tuple[str, ...]  # accepted units; empty for any single unit
    description: str  # number of columns, and their components or streams
    without: str = ""  # sentence on the consequence if they are missing; empty if they are required
    stream: str = ""  # stream with the columns, if the task looks for it by name


@dataclass(frozen=True)
class Label:
    """A label of recordings that a task reads."""

    name: str
    description: str
    without: str = ""


@dataclass(frozen=True)
class Requirements:
    """A task's requirements on recordings, and the stages that prepare them."""

    task: str
    stages: Sequence[str]  # stages whose output the task reads, in order
    optional_stages: Sequence[str]
    roles: str  # roles that the split must contain
    channels: Sequence[Channels]
    labels: Sequence[Label] = ()

    @property
    def needed(self) -> tuple[str, ...]:
        """The required quantities."""
        return tuple(channel.quantity for channel in self.channels if not channel.without)

    def to_text(self) -> str:
        """Return the requirements as lines of text."""
        chain = ", then ".join(f"tacpipe {stage}" for stage in self.stages) or "any stage, or recordings as they are"
        lines = [f"tacpipe train {self.task} reads the output of", f"  {chain}"]
        lines += [f"  (optional: {stage})" for stage in self.optional_stages]
        lines += ["", "roles in the split", *_wrap(self.roles, "  "), ""]
        lines += ["channels, selected by the quantity and unit of a column, in any stream unless a stream is named"]
        for channel in self.channels:
            place = f", stream {channel.stream}" if channel.stream else ""
            head = f"  {channel.quantity} [{' or '.join(channel.units) or 'any unit'}]{place}: "
            lines += _wrap(f"{channel.description}. {_format_need(channel.without)}", head)
        if self.labels:
            lines += ["", "labels of recordings"]
            lines += [
                line
                for label in self.labels
                for line in _wrap(f"{label.description}. {_format_need(label.without)}", f"  {label.name}: ")
            ]
        lines += [
            "",
            "Set quantity, unit, component and {taxel} in the [streams.NAME] columns of a layout file, and labels in its",
            "[[labels]] or [attributes]. tacpipe label DATASET --from TABLE sets labels later.",
        ]
        return "\n".join(lines)


def _format_need(without: str) -> str:
    return f"Optional. {without}" if without else "Required."


def _wrap(text: str, head: str) -> list[str]:
    return wrap(text, REQUIREMENT_WIDTH, initial_indent=head, subsequent_indent="      " if head.strip() else head)
