"""What a task needs of recordings, by quantity and unit: what `tacpipe train TASK --requirements` prints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import wrap

WIDTH = 110  # of the text
ANY = "any"


@dataclass(frozen=True)
class Channels:
    """Columns of one quantity that a task reads."""

    quantity: str
    units: tuple[str, ...]  # none: any one unit
    what: str  # how many, of which components or streams
    without: str = ""  # what happens without them; empty: they are needed
    stream: str = ""  # the stream that they are columns of, where the task looks for it by name


@dataclass(frozen=True)
class Label:
    """A label of recordings that a task reads."""

    name: str
    what: str
    without: str = ""


@dataclass(frozen=True)
class Requirements:
    """What recordings must hold to train a task, and which stages prepare them."""

    task: str
    stages: Sequence[str]  # whose output it takes, in order
    optional_stages: Sequence[str]
    roles: str  # what the split must have
    channels: Sequence[Channels]
    labels: Sequence[Label] = ()

    @property
    def needed(self) -> tuple[str, ...]:
        """The quantities without which a recording is refused."""
        return tuple(one.quantity for one in self.channels if not one.without)

    def to_text(self) -> str:
        """Return all of it as lines."""
        chain = ", then ".join(f"tacpipe {stage}" for stage in self.stages)
        lines = [f"tacpipe train {self.task} reads the output of", f"  {chain}"]
        lines += [f"  (optional: {stage})" for stage in self.optional_stages]
        lines += ["", "roles of the split", *_wrapped(self.roles, "  "), ""]
        lines += ["channels: found by the quantity and unit of a column, in any stream unless one is named"]
        for one in self.channels:
            place = f", stream {one.stream}" if one.stream else ""
            head = f"  {one.quantity} [{' or '.join(one.units) or 'any unit'}]{place}: "
            lines += _wrapped(f"{one.what}. {_need(one.without)}", head)
        if self.labels:
            lines += ["", "labels of recordings"]
            lines += [
                line for one in self.labels for line in _wrapped(f"{one.what}. {_need(one.without)}", f"  {one.name}: ")
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
