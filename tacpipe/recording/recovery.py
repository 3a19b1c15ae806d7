"""What recordings that a crash cut off left behind: their spools, sealed by the next command of the same user."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tacpipe.errors import TacpipeError
from tacpipe.printable import plain
from tacpipe.recording import spool_folders, trials
from tacpipe.recording.appending import NothingError
from tacpipe.recording.trials import Recorded
from tacpipe.store.store import Store

MOST_WORDS = 300  # characters of an error that is not one of ours


@dataclass(frozen=True)
class Stayed:
    """A spool that could not be sealed."""

    folder: Path
    why: str

    def line(self) -> str:
        """Return it in words."""
        return f"The spool {self.folder} stays as it is. {self.why}"


def recovered(store: Store, output: Path | None) -> Iterator[Recorded | Stayed]:
    """Seal the spools that no process holds and yield what became of each; one without a sample is passed over.

    What cannot be sealed stays, and keeps nobody from recording. ``output`` is the dataset that the command was given.
    """
    for folder in spool_folders.abandoned(store.root):
        try:
            with spool_folders.locked(folder) as ours:
                if not ours:
                    continue
                found = trials.recover(store, folder, output)
        except NothingError:
            continue  # it ended before a sample came
        except TacpipeError as error:
            yield Stayed(folder, str(error))
        except Exception as error:  # whatever a damaged spool or another version's driver may raise
            yield Stayed(folder, plain(f"{type(error).__name__}: {error}", MOST_WORDS))
        else:
            yield found


def of_others(store: Store) -> dict[Path, str]:
    """Return the spools that another user recorded, in a store that is shared, and whose they are."""
    with contextlib.suppress(OSError):  # of a disk that failed, which was stated already
        owners = spool_folders.owners(store.root)
        ours = spool_folders.users(store.root / spool_folders.FOLDER, owners.values())
        return {folder: spool_folders.user(owner) for folder, owner in owners.items() if owner not in ours}
    return {}
