"""Files that the recordings of a run share: each is made once, and gone with the run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tacpipe.errors import TacpipeError, is_input_error
from tacpipe.io import files, regular
from tacpipe.io.files import Draft, move, present
from tacpipe.io.hashing import digest
from tacpipe.store.store import Store

_MOST_BYTES = 1 << 20  # Longest error message


@dataclass(frozen=True)
class SharedFiles:
    """The shared files of the run that a store works for, among its drafts: a collection sweeps those of dead runs."""

    store: Store

    def file(self, content_key: Any, make: Callable[[Draft], None]) -> Path:
        """Return the file that ``make`` wrote for the JSON value ``content_key``, now or earlier in any process.

        Raises the errors of ``make``; an input error is stored and raised again for each caller.
        """
        key = digest({"run": self.store.run, "of": content_key})
        path, failed = (self.store.draft(digest([key, part])[:32]) for part in ("made", "failed"))
        with self.store.leases.hold(key, "the recordings of a file"):
            if present(failed):
                raise TacpipeError(regular.content(failed, _MOST_BYTES, follow=False).decode())
            if not present(path):
                name = self.store.draft()
                with files.new_draft(name, self.store.root) as draft:
                    try:
                        make(draft)
                    except TacpipeError as error:
                        if is_input_error(error):
                            self.store.write_file(failed, str(error).encode())
                        raise
                    move(name, path)
        return Path(path)
