"""What lies at a command's output, and making it show a result: a dataset with its labels, or one file of it."""

from __future__ import annotations

from pathlib import Path

from tacpipe import directory
from tacpipe import manifest as manifest_of
from tacpipe.errors import DamagedError, TacpipeError, UsageError, WouldChangeError
from tacpipe.hashing import bytes_digest, file_digest
from tacpipe.manifest import Manifest
from tacpipe.request import Request
from tacpipe.store import Store


def shown(store: Store, request: Request, hit: Manifest) -> bool:
    """Return whether the output holds the answer already and nothing is to be written; a dataset's root too is known."""
    root = store.roots.get(request.output.absolute())
    if root is None:
        return False
    if request.single_file:
        known = root["manifest"] == bytes_digest(hit.content) and request.output.exists()
        return known and file_digest(request.output) == hit.files[_single(request, hit)]["digest"]
    wanted = labelled(store, request, hit)
    known = root["manifest"] == bytes_digest(wanted.content) and store.has(root["manifest"])
    return known and directory.shown(store, wanted, request.output.absolute())


def labelled(store: Store, request: Request, made: Manifest) -> Manifest:
    """Return recordings with the labels that were set by hand on those they replace.

    Raises `DamagedError` if these cannot be told: no rerun would bring them back.
    """
    if not made.recorded or not (request.output / manifest_of.NAME).exists():
        return made
    try:
        before = manifest_of.find(request.output).manifest
    except TacpipeError as error:
        before = _before(store, request.output, error)
    return made.labelled(before.labels) if before.labels else made


def _before(store: Store, output: Path, error: TacpipeError) -> Manifest:
    """Return the manifest that was written at ``output``, which is damaged now, from the store."""
    root = store.roots.get(output.absolute())
    try:
        if root is not None:
            return manifest_of.parse(store.read(root["manifest"]), "the stored manifest", verified=True)
    except TacpipeError:
        pass
    raise DamagedError(
        f"{error} Labels that were set by hand may stand in it, and would be lost: bring it back with git, or remove it to "
        f"go on without them."
    )


def check(store: Store, request: Request, made: Manifest) -> None:
    """Raise `WouldChangeError` where the output was made from anything else."""
    root = store.roots.get(request.output.absolute())
    if root is None or root["manifest"] != bytes_digest(made.content):
        raise WouldChangeError(f"{request.output} would change: it was made from other inputs or params.")


def publish(store: Store, request: Request, made: Manifest) -> Manifest:
    """Return the manifest that the output shows now."""
    if request.single_file:
        _publish_file(store, request, made)
        return made
    if not made.recorded:
        directory.publish(store, made, request.output)
        return made
    with directory.changing(store, request.output):  # somebody may be about to label what is there
        made = labelled(store, request, made)
        store.put(made.content)
        directory.publish_alone(store, made, request.output)
    return made


def _publish_file(store: Store, request: Request, made: Manifest) -> None:
    output = request.output.absolute()
    wanted = made.files[_single(request, made)]["digest"]
    with directory.changing(store, output), directory.writing(output):
        if not output.exists() or file_digest(output) != wanted:
            directory.sweep_beside(output)
            directory.place(store, wanted, output, copy=True)
        store.roots.set(output, bytes_digest(made.content))


def _single(request: Request, made: Manifest) -> str:
    """Return the name of the file that is asked for in place of a dataset."""
    name = next((name for name in made.files if name.endswith(request.output.suffix)), None)
    if name is None:
        raise UsageError(f"{request.name} makes no {request.output.suffix} file; give -o a directory.")
    return name
