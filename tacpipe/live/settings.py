"""Read the settings of a live session, from ``[live]`` of a rig file or options, and define a task's part of sessions.

[live]
model = "models/forward"
publish = ["ws:127.0.0.1:8765"]
settle_ms = 2

A session has `Settings`, common to all tasks, and those of the task that its model was trained for.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self, get_args, get_origin

from tacpipe.errors import UsageError
from tacpipe.io import Json, Scalar
from tacpipe.plugins import fields, params, registry
from tacpipe.plugins.constraints import Range
from tacpipe.plugins.stage import Attribute, Result

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Model
    from tacpipe.live.engine import Engine
    from tacpipe.plugins.model import PredictionRequest
    from tacpipe.recording.rig import Rig
    from tacpipe.sensors.live import Declaration
    from tacpipe.sensors.sensor import Options, Sensor

SettingValues = Mapping[str, Scalar | Sequence[Scalar] | None]  # values by name, from a rig file or options
NOT_SET = ("task", "places")  # fields of `Settings` that are neither keys nor options


@dataclass(frozen=True)
class TaskSettings:
    """The settings specific to sessions of one task. Subclasses are frozen dataclasses whose field comments are the help."""

    @classmethod
    def override(cls, file_settings: SettingValues, options: SettingValues) -> SettingValues:
        """Return the settings of a rig file without the keys that ``options`` override."""
        return file_settings

    def check(self, settings: Settings) -> None:
        """Raise `UsageError` for an invalid combination of settings."""


@dataclass(frozen=True)
class Settings:
    """Settings common to sessions of all tasks, and those of the task. Names are those of options, with ``_`` for ``-``."""

    model: str = ""  # Model that tacpipe train wrote
    publish: tuple[str, ...] = ()  # Address to publish to: ws:HOST:PORT, udp:HOST:PORT, lsl:NAME, mcap:FILE
    settle_ms: Annotated[float, Range(0, 1000)] = 2.0  # Waiting time for the samples of a row, ms [2]
    realtime: bool = False  # Real-time scheduling of the session, if the system allows it
    allow_look_ahead: bool = False  # Accept a model that was trained on rows that look ahead
    task: TaskSettings = field(default_factory=TaskSettings)  # settings of the model's task
    places: Mapping[str, str] = field(default_factory=dict, compare=False)  # file and table of each key set in a file

    @classmethod
    def from_sources(
        cls,
        task_settings: type[TaskSettings],
        file_settings: SettingValues,
        rig_file: str,
        options: SettingValues,
    ) -> Self:
        """Return the settings in the table ``[live]`` of ``rig_file``, overridden by ``options``.

        ``task_settings`` is the dataclass of the task's settings; options that were not given are None. Raises
        `UsageError`, which names file and key, or the option, for an unknown key, an invalid value, and an invalid
        combination.
        """
        given_options = {name: value for name, value in options.items() if value is not None}
        common = {name: kind for name, kind in fields.hints(cls).items() if name not in NOT_SET}
        task_fields = fields.hints(task_settings)
        allowed = {**common, **task_fields}
        for name, value in given_options.items():
            if name not in allowed:
                raise UsageError(
                    f"This model has no setting {option(name)}; there are {', '.join(map(option, allowed))}."
                )
            fields.check(value, allowed[name], option(name))
        for name in file_settings:
            if name not in allowed:
                raise fields.unknown(name, allowed, f"{rig_file}, live", "key")
        source = f"{rig_file}, live"
        used_settings = task_settings.override(file_settings, given_options)
        places = {name: source for name in used_settings if name not in given_options}
        values = {**used_settings, **given_options}
        task = params.build_dataclass(
            task_settings, {name: value for name, value in values.items() if name in task_fields}, source, "key"
        )
        common_values = {name: value for name, value in values.items() if name in common}
        base = params.build_dataclass(cls, common_values, source, "key")
        settings: Self = replace(base, task=task, places=places)
        task.check(settings)
        return settings

    @contextlib.contextmanager
    def naming(self, name: str) -> Iterator[None]:
        """Make an error about a key's option, raised in the block, name the file and key if a file sets it."""
        try:
            yield
        except UsageError as error:
            if name not in self.places:
                raise
            raise UsageError(f"{self.places[name]}: {str(error).replace(option(name), name)}") from error


@dataclass(frozen=True)
class SessionOptions:
    """A live session as passed from the recording process to the model's process."""

    task: str  # name of the model's task
    rig: str  # text of the rig file, with the session's own streams
    streams: tuple[str, ...]  # streams of the rig that are passed on, ordered by their numbers
    own_streams: tuple[str, ...]  # streams that the session adds to the rig
    settings: Settings  # its paths are absolute
    nice: int = 1  # niceness of the model's process, which yields to the recording

    def to_json(self) -> str:
        """Return the options as one line."""
        return json.dumps(asdict(self)) + "\n"

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Return the options in a line from `to_json`. Raises `UsageError` if the task does not run live."""
        content = json.loads(text)
        live: LiveTask | None = registry.load_task(content["task"]).live
        if live is None:
            raise UsageError(f"Models of the task {content['task']} do not run live.")
        common = content["settings"]
        task = live.settings(**_tuples(common["task"]))
        settings = replace(
            Settings(**_tuples({name: common[name] for name in common if name not in NOT_SET})), task=task
        )
        return cls(**{**_tuples(content), "settings": settings})


def _tuples(values: Json) -> Json:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}


def option(name: str) -> str:
    """Return the option of the command for a key.

    >>> option("settle_ms")
    '--settle-ms'
    """
    return f"--{name.replace('_', '-')}"


def parse_option(name: str, text: Any, annotation: Any) -> Any:
    """Return the value of an option's text for an annotation; a list is comma-separated.

    >>> parse_option("steps", "1,5", tuple[int, ...]), parse_option("settle_ms", "3", float)
    ((1, 5), 3.0)

    Raises `UsageError` if the value is invalid for the annotation.
    """
    if not isinstance(text, str):
        return text
    kind = fields.bare(annotation)
    value: Any = fields.parse_text(text, annotation)
    if get_origin(kind) is tuple:
        value = tuple(fields.parse_text(part, get_args(kind)[0]) for part in text.split(",")) if text else ()
    return fields.check(value, annotation, option(name))


def task_settings() -> dict[str, type[TaskSettings]]:
    """Return the settings dataclass of each task with live sessions, by task name."""
    tasks: dict[str, LiveTask | None] = {name: registry.load_task(name).live for name in registry.tasks()}
    return {name: live.settings for name, live in tasks.items() if live is not None}


def keys(settings: type[Any]) -> list[str]:
    """Return the keys of a dataclass of settings."""
    return [field.name for field in dataclasses.fields(settings) if field.name not in NOT_SET]


@dataclass(frozen=True)
class SessionPlan:
    """A live session that a task has checked against model, rig and settings."""

    rig: Rig  # includes additional streams that the engine needs
    settings: TaskSettings  # completed
    streams: Mapping[str, Options]  # recorded streams with the options of the sensor ``live``
    attributes: Mapping[str, Attribute] = field(default_factory=dict)  # further attributes of the recording


class LiveTask(ABC):
    """A task's part of live sessions. Modules of subclasses import torch and pyarrow only inside methods."""

    # dataclass of its settings: options of ``tacpipe live`` and keys of ``[live]``
    settings: ClassVar[type[TaskSettings]]
    declaration: ClassVar[Declaration]  # the values of its messages

    @abstractmethod
    def plan(self, model: Dataset, rig: Rig, settings: Settings) -> SessionPlan:
        """Return the plan of a session from the model's configuration, without importing torch.

        Raises `UsageError` for settings that do not match model or rig, and `TacpipeError` if the model was trained on
        rows that look ahead, unless the settings allow it.
        """

    @abstractmethod
    def engine(self, model: Dataset, rig: Rig, sensors: Mapping[str, Sensor], settings: Settings) -> Engine:
        """Return the engine that converts samples of ``sensors``, by stream, to messages; runs in the model's process.

        Raises `UsageError` if model, rig and settings do not match.
        """

    def predict(self, model: Model, recordings: Dataset, request: PredictionRequest) -> Result:
        """Return the messages that a session would publish for recordings (``predict --causal``).

        Raises `UsageError` if the task has no such predictions.
        """
        raise UsageError(f"Models of the task {self.declaration.kind} have no causal predictions; leave --causal out.")

    def evaluate(self, model: Model, recordings: Dataset) -> Result:
        """Return metrics of what sessions published in their recordings (``evaluate --live``).

        Raises `UsageError` if the task has no such metrics.
        """
        raise UsageError(f"Sessions of the task {self.declaration.kind} are not evaluated; leave --live out.")
