"""The number of the class of each label: whole numbers stay, any other labels are numbered in order."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tacpipe.arrays import AnyArray, Int64s
from tacpipe.errors import TacpipeError
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import listed, plain
from tacpipe.tasks.material.params import KEY

if TYPE_CHECKING:
    import pyarrow as pa

UNKNOWN = -1  # stands where a slide has no label


@dataclass(frozen=True)
class Naming:
    """The label of a recording that names its class, and the classes in order; without names they are whole numbers."""

    key: str = KEY
    names: tuple[str, ...] = ()

    @classmethod
    def from_labels(cls, key: str, labels: Iterable[Attribute]) -> Naming:
        """Return the naming of these labels: whole numbers from 0 stay, any other labels are sorted and numbered as text.

        >>> Naming.from_labels("material", [3, 1]).names, Naming.from_labels("object", ["cup", None, "can"]).names
        ((), ('can', 'cup'))
        """
        present = [label for label in labels if label is not None]
        if all(_is_number(label) for label in present):
            return cls(key)
        return cls(key, tuple(sorted({text(label) for label in present})))

    def number(self, label: Attribute) -> int:
        """Return the number of a label, `UNKNOWN` for none. Raises `TacpipeError` for one that has no number."""
        if label is None:
            return UNKNOWN
        if not self.names:
            if isinstance(label, int) and _is_number(label):
                return label
            raise TacpipeError(f"{self.key} {plain(text(label))} is not a whole number from 0, as the others are")
        if text(label) not in self.names:
            raise TacpipeError(f"{self.key} {plain(text(label))} is not one of {listed(self.names, 20)}")
        return self.names.index(text(label))

    def read(self, word: str) -> int:
        """Return the number of a class that an option names. Raises `ValueError` where there is none of this name."""
        return self.names.index(word) if self.names else int(word)

    def name(self, number: int) -> str:
        """Return the name of a class, as messages and columns have it.

        >>> Naming().name(3), Naming("material", ("cork", "felt")).name(1)
        ('3', 'felt')
        """
        return self.names[number] if self.names else str(number)

    def names_for(self, numbers: Int64s) -> NDArray[Any]:
        """Return the names of classes (slide,): text, or the numbers where these are the names."""
        if not self.names:
            return numbers
        return np.array([self.names[number] if number >= 0 else "" for number in numbers.tolist()], dtype=np.str_)

    def to_json(self) -> dict[str, Any]:
        """Return what a model's configuration holds of it: nothing of whole numbers under the usual key."""
        return ({} if self.key == KEY else {"label": self.key}) | ({"names": list(self.names)} if self.names else {})

    @classmethod
    def from_json(cls, config: Any) -> Naming:
        """Return the naming in a model's configuration."""
        return cls(str(config.get("label", KEY)), tuple(map(str, config.get("names", ()))))


NUMBERS = Naming()  # whole numbers, under the usual key


def text(label: Attribute) -> str:
    """Return a label as text: true and false as they are written in YAML.

    >>> text(True), text(3), text("cork")
    ('true', '3', 'cork')
    """
    return str(label).lower() if isinstance(label, bool) else str(label)


def field(name: str, values: AnyArray, quantity: str) -> tuple[pa.Field, list[Any]]:
    """Return a column of classes and its values: int32 where they are whole numbers, else text, nothing where unknown."""
    import pyarrow as pa

    about = {"quantity": quantity}
    if values.dtype.kind in "iu":
        return pa.field(name, pa.int32(), metadata=about), values.tolist()
    return pa.field(name, pa.string(), metadata=about), [name or None for name in values.tolist()]


def _is_number(label: Attribute) -> bool:
    return isinstance(label, int) and not isinstance(label, bool) and label >= 0
