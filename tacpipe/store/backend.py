"""Define the interface of the place that keeps a store's bytes: six operations on names, for folders and buckets.

A name is a path within the store, as `docs/format.md` lists them, such as ``objects/ab/ab12…``. A place that computers share
needs no more than that one of several that create a name wins: what has to change gets another name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple, Protocol, TypeVar

from tacpipe.errors import StorageError
from tacpipe.io import regular

AT_ONCE = 16  # requests on their way at once


class Entry(NamedTuple):
    """State of one name in a place."""

    name: str
    bytes: int
    changed_s: float  # seconds of UTC since 1970, by the clock of the place


T = TypeVar("T")


class Backend(Protocol):
    """A place that keeps bytes by name.

    Every method raises `StorageError` if the place fails. Such an error states nothing about what the place holds.
    """

    place: str  # Name in messages

    def create(self, name: str, content: bytes | Iterable[bytes]) -> bool:
        """Keep ``content``, whole or in blocks, under a name that nothing has; return False where something has it.

        Of several that create one name at once one wins. Nobody ever sees a part of the content.
        """

    def read(self, name: str, max_bytes: int | None = None) -> bytes:
        """Return the content of at most ``max_bytes`` bytes.

        Raises `FileNotFoundError` where there is none, and `IrregularError` for one that is larger or is not content.
        """

    def blocks(self, name: str, max_bytes: int) -> Iterator[bytes]:
        """Yield the content block by block; raises as `read` does."""

    def stat(self, name: str) -> Entry | None:
        """Return what the place states of a name, None where nothing has it; raises `IrregularError` as `read` does."""

    def list(self, folder: str) -> Iterator[Entry]:
        """Yield what has the form of a store's names within ``folder``, at any depth, in no order.

        What is deleted meanwhile may be left out.
        """

    def move(self, name: str, to: str) -> bool:
        """Give content another name, and replace what has that; return False where nothing has ``name``.

        Whoever looks finds it under the one name, the other, or both.
        """

    def delete(self, name: str) -> None:
        """Keep a name no longer; one that nothing has is no mistake."""


def read_twice(files: Backend, name: str, max_bytes: int, parse: Callable[[bytes], T | None]) -> T | None:
    """Return the parsed content of a file, which is read again if the first answer cannot be parsed.

    Returns None only if the second answer agrees with the first: an answer may be damaged on its way. Raises
    `StorageError` if they differ, and `FileNotFoundError` where no such file exists.
    """
    answers: list[bytes | str] = []
    for _ in range(2):
        try:
            answer: bytes | str = files.read(name, max_bytes)
        except regular.IrregularError as error:
            answer = str(error)
        parsed = parse(answer) if isinstance(answer, bytes) else None
        if parsed is not None:
            return parsed
        answers.append(answer)
    if answers[0] != answers[1]:
        raise StorageError(
            f"{files.place} gives {name} with other content each time, so whether it is damaged is unknown. Check the "
            f"connection and the server, then run the same command again."
        )
    return None
