"""Declare stages: typed functions with a version, whose signature determines their inputs.

The first parameter is ``params``, a frozen dataclass or a union of several (`tacpipe.plugins.params`). The annotation
of each further parameter determines what the stage reads:

=================  ==================================================================================================
``Recording``      one recording; the stage is run, keyed and stored for each recording separately
``Dataset``        all recordings; an argument named ``train``, ``val`` or ``test`` contains only that role, and may be
                   empty if it is annotated ``Dataset | None``
``Datasets``       several datasets, as a tuple
``Rows``           the rows that were read for each of the ``Datasets`` and those that it comes from, by stage
``Model``          a trained model: a `Dataset` whose ``files`` contain weights and configuration; ``init`` is optional
``Fitted``         the files that a nested stage computed from the training recordings: ``Annotated[Fitted, fit]``
``Parts``          the results of a nested stage for each recording, as a `Dataset`: ``Annotated[Parts, part]``
``RecordingName``  the name of the recording; it becomes part of the key, so only stages that need it have it
``Files``          the files of one recording of a source, found by the stage's ``source``
``Values``         further values from ``source`` for one recording, such as labels; part of its key
``Shared``         files shared by the recordings of a run, each created once; ``Shared | None``, as there may be no run
``Trial``          the index of one recording to simulate, from 0 to ``params.trials``
``Roles``          role by (recording, fold), empty without the option: ``extend`` contains those of the older split given
                   by ``--extend``, ``split`` those of one fold of ``--split``
``Workspace``      a folder for checkpoints that survives an interruption
=================  ==================================================================================================

What a stage needs beyond its inputs is a nested call in the annotation of the argument. A nested stage has the params of
the stage, and its own version and stored results, whose files become files of the result. In ``Annotated[Dataset,
prepare]``, ``prepare`` is a function from the params to the stages that the recordings go through first.

Annotations are read as text, so a stage module imports nothing for them outside ``TYPE_CHECKING``.
"""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, ParamSpec, Protocol, TypeAlias, TypeVar, cast

from tacpipe.errors import TacpipeError
from tacpipe.io import Json
from tacpipe.plugins.rows import StreamRows

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.io.files import Draft

ROLES = ("train", "val", "calibration", "test")
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


@dataclass(frozen=True)
class Discovery:
    """How a stage finds recordings in a folder; the functions get the params and the folder, or only the folder.

    ``why_unread`` returns a function from a path in the folder to the reason why the file is not read, or "" for a file
    that is used otherwise, such as labels. ``preview`` describes what would be read (``--dry-run``), and ``guess`` returns
    a first layout file (``--guess``).
    """

    discover: Discover
    why_unread: Callable[[Any, Path], Callable[[str], str]] | None = None
    preview: Callable[[Any, Path], str] | None = None
    guess: Callable[[Path], str] | None = None


# params -> params of the stages that recordings go through first, by name; None for the stages of the model's chain
Prepare = Callable[[Any], Mapping[str, Values] | None]


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
    source: Discovery | None = None  # how ``Files`` are found; the result cannot be recomputed from the store
    headline: str | None = None  # file of the result with its headlines, which the command prints
    originals: Callable[[Any], str] | None = None  # folder of the result for input shards; empty for none

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Call the function with the streams that its params select, without a store."""
        params: Any = args[0] if args else kwargs.get("params")
        if not hasattr(params, "narrow"):  # only a `StreamSelection` has this method
            return self.function(*args, **kwargs)
        bound = inspect.signature(self.function).bind(*args, **kwargs)
        if name := self.argument("Recording"):
            bound.arguments[name] = params.narrow(bound.arguments[name])
        output = self.function(*bound.args, **bound.kwargs)
        return cast("R", params.narrow_output(output)) if self.source is not None else output

    @functools.cached_property
    def _annotations(self) -> dict[str, tuple[str, Any]]:
        """The annotated type as text and the nested call (or None) of each argument after ``params``, by name."""
        names = inspect.unwrap(self.function).__globals__
        parameters = list(inspect.signature(self.function).parameters.items())[1:]
        return {name: _split_annotation(parameter.annotation, names) for name, parameter in parameters}

    @functools.cached_property
    def arguments(self) -> dict[str, str]:
        """The kind of each argument after ``params``, by name. Raises `TacpipeError` for an unknown annotation."""
        kinds = {}
        for name, (text, nested) in self._annotations.items():
            kind = text.removesuffix(" | None").rpartition(".")[2]
            if kind not in _KINDS:
                raise TacpipeError(
                    f"Stage {self.function.__name__} annotates {name} as {kind}; known are {', '.join(_KINDS)}."
                )
            if kind in ("Fitted", "Parts") and nested is None:
                raise TacpipeError(
                    f"Stage {self.function.__name__} annotates {name} as {kind}; it must be Annotated[{kind}, STAGE], with "
                    f"the stage that computes it."
                )
            kinds[name] = kind
        return kinds

    def argument(self, kind: str) -> str | None:
        """Return the name of the argument of this kind, or None if there is none."""
        return next((name for name, argument_kind in self.arguments.items() if argument_kind == kind), None)

    def optional(self, name: str) -> bool:
        """Return whether the argument ``name`` is optional."""
        return self._annotations[name][0].endswith(" | None")

    @property
    def fit(self) -> AnyStage | None:
        """The nested stage that computes the files of the argument ``Fitted``."""
        return self._nested("Fitted")

    @property
    def part(self) -> AnyStage | None:
        """The nested stage that runs on each recording and computes the argument ``Parts``."""
        return self._nested("Parts")

    def _nested(self, kind: str) -> AnyStage | None:
        name = self.argument(kind)
        return None if name is None else cast("AnyStage", self._annotations[name][1])

    def prepare(self, name: str) -> Prepare | None:
        """Return the function from params to the stages that the recordings of argument ``name`` go through first."""
        return cast("Prepare | None", self._annotations[name][1]) if self.arguments[name] == "Dataset" else None

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


_ANNOTATED = re.compile(r"(?:[\w.]+\.)?Annotated\[(?P<type>.+), *(?P<nested>\w+)\]")


def _split_annotation(annotation: Any, names: Mapping[str, Any]) -> tuple[str, Any]:
    """Return the type of an annotation as text, and the nested call of an ``Annotated`` type, or None.

    ``names`` are the global names of the stage's module. Raises `TacpipeError` for a nested call that is not among them.

    >>> _split_annotation("Annotated[Parts, part]", {"part": len}), _split_annotation(Path, {})
    (('Parts', <built-in function len>), ('Path', None))
    """
    if metadata := getattr(annotation, "__metadata__", ()):
        return _split_annotation(annotation.__origin__, names)[0], metadata[0]
    text = annotation.__name__ if isinstance(annotation, type) else str(annotation).strip("'\"")
    match = _ANNOTATED.fullmatch(text)
    if match is None:
        return text, None
    if match["nested"] not in names:
        raise TacpipeError(f"{text} names {match['nested']}, which its module does not define.")
    return match["type"], names[match["nested"]]


def stage(
    *,
    version: int,
    reads: tuple[str, ...] | None = None,
    source: Discovery | None = None,
    headline: str | None = None,
    originals: Callable[[Any], str] | None = None,
) -> Callable[[Callable[P, R]], Stage[P, R]]:
    """Return a decorator that makes a function a stage with the same signature.

    Increase ``version`` whenever the stage's result changes. ``source`` finds the recordings of a stage that reads
    ``Files``. ``headline`` is the file of the result (`tacpipe.scores.headline`) that the command prints as a table.
    """
    return lambda function: Stage(function, version, reads, source, headline, originals)
