"""Define a bucket in which something else happens before one of the requests."""

from collections.abc import Callable, Iterator
from typing import Any

from tacpipe.store.backend import Entry
from tacpipe.store.bucket import Bucket


class Stepping(Bucket):
    """A bucket in memory, in which something else happens before one of its steps."""

    def __init__(self, content: dict[str, bytes], step: int = 0, action: Callable[[], object] = lambda: None) -> None:
        from obstore.store import MemoryStore

        client = MemoryStore()
        super().__init__("s3://lab/store", client)
        self.days = 0
        self.begin(0, lambda: None)
        for name, value in content.items():
            assert self.create(name, value)

    def _retry(self, request: Callable[[], Any], tries: int = 0) -> Any:
        self.steps += 1
        if self.steps == self._step:
            self._action()
        return super()._retry(request, tries)

    def begin(self, step: int, action: Callable[[], object]) -> None:
        """Count steps from here, and call ``action`` before the step of this number."""
        self.steps, self._step, self._action = 0, step, action

    def list(self, folder: str) -> Iterator[Entry]:
        """Do as `Bucket.list`; what is there is listed as ``days`` older than it is."""
        for entry in super().list(folder):
            yield entry._replace(changed_s=entry.changed_s - self.days * 86400)

    def content(self) -> dict[str, bytes]:
        """Return all content by name."""
        return {entry.name: self.read(entry.name) for entry in self.list("")}
