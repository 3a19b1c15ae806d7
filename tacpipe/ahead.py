"""Reading ahead: who goes through shards in order finds the next one verified already, by a thread beside the decoding."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from threading import Thread

from tacpipe.hashing import bytes_digest

WORTH_BYTES = 1 << 20  # hashing less takes no longer than a thread takes to start
_HELD = 4  # shards at most that were read ahead and not asked for: as many streams can be gone through side by side


class Ahead:
    """A reader (digest, path -> verified content) that reads ahead for whoever asks for one shard after another.

    Nothing is handed out that was not verified, and nothing is mended ahead: what a thread finds missing or damaged is
    read again by ``read`` when it is asked for.
    """

    def __init__(
        self,
        read: Callable[[str, str], bytes],
        place: Callable[[str], str],
        sequences: Callable[[], Iterator[Sequence[tuple[str, str]]]],
    ) -> None:
        self._read, self._place = read, place  # place: where the content of a digest lies
        self._sequences = sequences  # of (digest, path), as they follow each other; asked for when something is read
        self._next: dict[str, tuple[str, str]] | None = None
        self._last: set[str] = set()  # paths that would follow on what was read
        self._readings: dict[str, _Reading] = {}

    def __call__(self, name: str, path: str) -> bytes:
        """Return the verified content."""
        reading = self._readings.pop(name, None)
        content = reading.result() if reading else None
        if content is None:
            content = self._read(name, path)
        if len(content) >= WORTH_BYTES:
            self._follow(path)
        return content

    def _follow(self, path: str) -> None:
        if self._next is None:
            self._next = {one[1]: other for given in self._sequences() for one, other in itertools.pairwise(given)}
        following = self._next.get(path)
        in_order = path in self._last
        self._last.discard(path)
        if following is None:
            return
        self._last.add(following[1])
        if in_order and len(self._readings) < _HELD and following[0] not in self._readings:
            self._readings[following[0]] = _Reading(following[0], self._place(following[0]))


class _Reading(Thread):
    """The reading of one object. A thread of its own, and no pool: in a process that was forked it simply is not there."""

    def __init__(self, name: str, place: str) -> None:
        super().__init__(name=f"ahead-{name[:12]}", daemon=True)
        self._digest, self._place, self._content = name, place, b""
        self._good = False
        self.start()

    def run(self) -> None:
        """Read and verify; what goes wrong is found again, and told, by whoever asks for the content."""
        try:
            with open(self._place, "rb", buffering=0) as file:
                content = file.readall()
        except (OSError, MemoryError):
            return
        if bytes_digest(content) == self._digest:
            self._content, self._good = content, True

    def result(self) -> bytes | None:
        """Return the content, or None where it could not be verified."""
        self.join()
        return self._content if self._good else None
