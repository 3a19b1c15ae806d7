"""Describe what recordings must contain for a task, by quantity and unit (``tacpipe train TASK --requirements``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import wrap

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
