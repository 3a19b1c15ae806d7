"""Architectures of a task: params classes that build models, found through entry points of ``tacpipe.models``.

A task has a dataclass that all of its architectures extend. Its ``ARCHITECTURES`` is the name of the task, and the
default of its first field, ``architecture``, is the default architecture. An entry point ``TASK.NAME = "module:Class"``
names a dataclass that extends it: its ``architecture`` is a ``Literal`` that includes ``NAME``, and ``build(shape)``
returns the object that the task trains. Built-in architectures and those of other packages are found in the same way,
and their classes are the kinds of params of the task's stage (`tacpipe.plugins.params`).

- The module is imported whenever the options of the stage are needed, so torch and other heavy libraries are imported
  in ``build``.
- The name and version of another package are part of the stored params (``plugin``) and so of every key: a model is
  trained again with another version. tacpipe's own architectures change with the version of the stage.
- An architecture that cannot be loaded is not offered as a choice; selecting it raises the reason.
- The shared loop of the task trains the result of ``build``, unless the architecture has its own method ``fit``. So
  no task depends on which architecture it trains.
- Each task documents the arguments and the result of ``build``: `tacpipe.tasks.forward.params.ForwardModelParams`,
  `tacpipe.tasks.material.params.NetworkParams`, `tacpipe.tasks.touch.params.Patches` and `Pointnet`. Architectures of
  ``classify`` and ``regress`` return estimators instead (`tacpipe.tasks.learning.params`).
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import warnings
from collections.abc import Iterable
from typing import Any

from tacpipe.errors import ResultWarning, TacpipeError
from tacpipe.plugins import fields as fields_of
from tacpipe.plugins import registry
from tacpipe.plugins.stage import StoredParams
from tacpipe.printable import excerpt, plain

PLUGIN = "plugin"  # key of a package's name and version in the stored params of its architecture
TAG = "architecture"
Kind = type[Any]


def task(kind: Any) -> str | None:
    """Return the task whose architectures extend exactly the class ``kind``, or None for other params."""
    return vars(kind).get("ARCHITECTURES") if isinstance(kind, type) else None


@functools.cache
def kinds(base: Kind) -> tuple[Kind, ...]:
    """Return the classes of the architectures that extend ``base``, the default one first.

    Leaves out architectures that cannot be loaded or that share a choice with an earlier one.
    """
    architectures: list[Kind] = []
    for name in registry.architectures(str(task(base))):
        with contextlib.suppress(TacpipeError):  # an architecture that cannot be loaded does not affect the others
            kind = load(base, name)
            if kind not in architectures and not _shared_choices(kind, architectures):
                architectures.append(kind)
    default = base.__dataclass_fields__[TAG].default
    return tuple(sorted(architectures, key=lambda kind: default not in fields_of.choices(kind, TAG)))


def load(base: Kind, name: str) -> Kind:
    """Return the class of the architecture ``name``. Raises `TacpipeError` if it does not match ``base``."""
    task_name = task(base)
    architecture = registry.load_architecture(str(task_name), name)
    target = registry.entry_points()[registry.MODELS][f"{task_name}.{name}"]
    requirements = {
        f"a dataclass that extends {base.__module__}.{base.__name__}": isinstance(architecture, type)
        and issubclass(architecture, base)
        and dataclasses.is_dataclass(architecture),
    }
    if all(requirements.values()):
        requirements[f"a dataclass whose {TAG} is a Literal with {name}"] = name in fields_of.choices(architecture, TAG)
        missing = sorted(getattr(architecture, "__abstractmethods__", ()))
        requirements[f"a class with the methods {', '.join(missing)}"] = not missing
    for requirement, fits in requirements.items():
        if not fits:
            raise TacpipeError(
                f"{target}, registered as the architecture {name} of {task_name}, must be {requirement}."
            )
    kind: Kind = architecture
    return kind


def find(base: Any, architecture: str) -> Kind | None:
    """Return the class of an architecture that extends ``base``, or None if its package is not installed."""
    return next((kind for kind in kinds(base) if architecture in fields_of.choices(kind, TAG)), None)


def find_or(base: Any, architecture: str) -> Kind:
    """Return the class of an architecture that extends ``base``, or ``base`` if its package is not installed."""
    return find(base, architecture) or base


def require(base: Any, value: Any) -> None:
    """Raise `TacpipeError` if ``value`` is an installed architecture that is hidden by another with the same choice.

    Does nothing for other values.
    """
    task_name = task(base)
    if task_name is None or not isinstance(value, str) or value not in registry.architectures(task_name):
        return
    kind = load(base, value)
    if kind not in (choosable := kinds(base)):
        choices = ", ".join(map(str, _shared_choices(kind, choosable)))
        raise TacpipeError(
            f"The architecture {value} of the package {plugin(kind)} has the choice {choices}, which another has too. "
            f"Rename it there."
        )


def plugin(kind: Kind) -> str | None:
    """Return the name and version of the package that provides an architecture, or None for tacpipe's own."""
    for base in kind.__mro__[1:]:
        if (task_name := task(base)) is not None:
            for name in fields_of.choices(kind, TAG):
                if name in registry.architectures(task_name) and (
                    package := registry.provider_of(registry.MODELS, f"{task_name}.{name}")
                ):
                    return str(package)
    return None


def check_installed(base: Any, values: StoredParams, kind: Kind | None) -> None:
    """Raise `TacpipeError` if stored params belong to an architecture that is not installed or cannot be loaded.

    ``kind`` is the class that they name, if it exists.
    """
    if kind is None and task(base) is not None:
        require(base, values.get(TAG))
        if PLUGIN in values:
            raise TacpipeError(
                f"The architecture {excerpt(values.get(TAG))} comes from the package {plain(str(values[PLUGIN]), 100)}, "
                f"which is not installed here. Install it to use the model."
            )


def warn_of_version(values: StoredParams, kind: Kind) -> None:
    """Warn if a model was trained with another version of its architecture's package than the installed one."""
    before, now = values.get(PLUGIN), plugin(kind)
    if before != now:
        trained = f"{excerpt(values.get(TAG))} of {plain(str(before), 100)}"
        sentence = (
            f"This model was trained with the architecture {trained}, and {now} is installed: predictions may differ."
        )
        warnings.warn(sentence, ResultWarning, stacklevel=2)


def check_version(values: StoredParams, kind: Kind) -> None:
    """Raise `TacpipeError` if stored params were computed with another version of the package than the installed one."""
    before, now = values.get(PLUGIN), plugin(kind)
    if before != now:
        raise TacpipeError(
            f"This was computed with the architecture {excerpt(values.get(TAG))} of {plain(str(before), 100)}, and {now} is "
            f"installed. Install that version, or train again."
        )


def _shared_choices(kind: Kind, architectures: Iterable[Kind]) -> list[Any]:
    """Return the choices of a class that another of the ``architectures`` also has."""
    other_choices = {
        choice
        for architecture in architectures
        if architecture is not kind
        for choice in fields_of.choices(architecture, TAG)
    }
    return [choice for choice in fields_of.choices(kind, TAG) if choice in other_choices]
