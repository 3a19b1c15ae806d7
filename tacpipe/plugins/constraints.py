"""Constraints on the values of params: metadata of ``Annotated``, checked when params are built and shown in help.

``pressure: Annotated[float, Unit("count"), Range(0, 4095)] = 40.0``, or ``rate_hz: PositiveFloat = 50.0``. A choice is
a ``Literal``. `StoredAs` gives the former name of a renamed param.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from tacpipe.errors import UsageError
from tacpipe.io import regular
from tacpipe.plugins import fields
from tacpipe.plugins.stage import Values
from tacpipe.printable import plain

MAX_TOML_BYTES = 1 << 20  # maximum size of a TOML file


@dataclass(frozen=True)
class Range:
    """A range of numbers. ``minimum`` and ``maximum`` are inclusive, ``above`` and ``below`` exclusive."""

    minimum: float | None = None
    maximum: float | None = None
    above: float | None = None
    below: float | None = None

    def allows(self, value: float) -> bool:
        """Return whether a number is in the range.

        >>> [Range(0, below=1).allows(number) for number in (-0.1, 0, 0.9, 1)]
        [False, True, True, False]
        """
        return not (
            (self.minimum is not None and value < self.minimum)
            or (self.maximum is not None and value > self.maximum)
            or (self.above is not None and value <= self.above)
            or (self.below is not None and value >= self.below)
        )

    def describe(self, kind: str) -> str:
        """Return a description of the numbers in the range.

        >>> Range(1).describe("a whole number"), Range(0, 1).describe("a number"), Range(above=0).describe("a number")
        ('a whole number of 1 or more', 'a number from 0 to 1', 'a number above 0')
        """
        if self.minimum is not None and self.maximum is not None:
            return f"{kind} from {self.minimum} to {self.maximum}"
        ends = [
            (self.minimum, "of {} or more"),
            (self.above, "above {}"),
            (self.maximum, "at most {}"),
            (self.below, "below {}"),
        ]
        return f"{kind} " + " and ".join(text.format(end) for end, text in ends if end is not None)


@dataclass(frozen=True)
class CommaList:
    """Comma-separated text whose items have the annotation ``item_type``."""

    item_type: Any = str
    min_items: int = 0

    def items(self, text: str) -> list[Any]:
        """Return the items of a valid text. Spaces around items and empty items are ignored.

        >>> CommaList(int).items("1, 5,10")
        [1, 5, 10]
        """
        return [fields.parse_text(part.strip(), self.item_type) for part in text.split(",") if part.strip()]

    def allows(self, value: str) -> bool:
        """Return whether there are enough items and each is valid."""
        items = self.items(value)
        return len(items) >= self.min_items and all(fields.fits(item, self.item_type) for item in items)

    def describe(self, kind: str) -> str:
        """Return a description of the list and its items."""
        return "a comma-separated list" + (
            "" if self.item_type is str else f", each item {fields.describe(self.item_type)}"
        )


@dataclass(frozen=True)
class Assignments:
    """A list of ``NAME=VALUE`` whose values have the annotation ``item_type``."""

    item_type: Any
    between: str = ","

    def items(self, text: str) -> Values:
        """Return the values of a valid text by name.

        >>> Assignments(float).items("biotac=0.025, roboskin=0.05")
        {'biotac': 0.025, 'roboskin': 0.05}
        """
        pairs = [part.partition("=") for part in text.split(self.between) if part.strip()]
        return {name.strip(): fields.parse_text(value.strip(), self.item_type) for name, _, value in pairs}

    def allows(self, value: str) -> bool:
        """Return whether all names are present and different, and each value is valid."""
        values = self.items(value)
        count = sum(bool(part.strip()) for part in value.split(self.between))
        return len(values) == count and all(name and fields.fits(item, self.item_type) for name, item in values.items())

    def describe(self, kind: str) -> str:
        """Return a description of the list and its values."""
        between = {",": "comma", ";": "semicolon"}[self.between]
        return f"a {between}-separated list of NAME=VALUE, each value {fields.describe(self.item_type)}"


@dataclass(frozen=True)
class Unit:
    """The unit of a number: ``"mm"``, ``"Hz"``, or ``"count"`` for a device's raw values."""

    name: str

    def allows(self, value: float) -> bool:
        """Return True, because a unit does not restrict values."""
        return True

    def describe(self, kind: str) -> str:
        """Return a description of the number with its unit.

        >>> Unit("mm").describe(Range(above=0).describe("a number"))
        'a number above 0 (mm)'
        """
        return f"{kind} ({self.name})"


@dataclass(frozen=True)
class StoredAs:
    """The former name and choices of a renamed param, which keys, manifests and models still use.

    So a new name in code and on the command line changes no key, and stored params remain readable.
    """

    name: str
    choices: Mapping[str, str] = field(default_factory=dict)  # stored choice by current choice


@dataclass(frozen=True)
class TomlFile:
    """Path of a TOML file. The param's value is the file's content as canonical JSON, without its path and comments."""

    def allows(self, value: str) -> bool:
        """Return True; the file is checked when it is read."""
        return True

    def describe(self, kind: str) -> str:
        """Return a description of the text."""
        return "the path of a TOML file"

    def read(self, path: str) -> str:
        """Return the content of the file at ``path`` as canonical JSON.

        Raises `UsageError` if the file does not exist or is not TOML.
        """
        import tomllib  # imported here, because not every command needs it

        if not path:
            return path
        try:
            content = regular.content(path, MAX_TOML_BYTES)
        except FileNotFoundError:
            raise UsageError(f"There is no file {path}. Give the path of a TOML file.") from None
        try:
            return json.dumps(
                tomllib.loads(content.decode("utf-8-sig")), sort_keys=True, ensure_ascii=False, default=str
            )
        except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise UsageError(f"{path} is not TOML: {plain(str(error), 200)}.") from error


PositiveInt = Annotated[int, Range(1)]
NonNegativeInt = Annotated[int, Range(0)]
PositiveFloat = Annotated[float, Range(above=0)]
NonNegativeFloat = Annotated[float, Range(0)]
Fraction = Annotated[float, Range(0, 1)]
Dropout = Annotated[float, Range(0, below=1)]
Seed = Annotated[int, Range(0, 2**32 - 1)]  # the range that numpy, torch and scikit-learn accept
Rate = Annotated[float, Range(above=0, maximum=1_000_000_000), Unit("Hz")]  # timestamps are integer nanoseconds
Names = Annotated[str, CommaList()]
