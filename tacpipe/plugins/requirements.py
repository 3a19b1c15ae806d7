"""Describe what recordings must hold for a task, by quantity and unit, as `tacpipe train TASK --requirements` prints it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import wrap

WIDTH = 110  # Characters per line
ANY = "any"


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
    return wrap(text, WIDTH, initial_indent=head, subsequent_indent="      " if head.strip() else head)
