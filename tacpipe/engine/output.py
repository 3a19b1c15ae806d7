"""What is at a command's output, and making it show a result: a dataset with its labels, or one file of it."""

from __future__ import annotations

from collections.abc import Mapping

from tacpipe.datasets import directory, replacing
from tacpipe.datasets.manifest import Manifest
from tacpipe.engine.request import Request
from tacpipe.errors import DamagedError, UsageError, WouldChangeError
from tacpipe.io.hashing import bytes_digest, file_digest
from tacpipe.plugins.stage import Attribute
from tacpipe.store.store import Store


def shown(store: Store, request: Request, hit: Manifest) -> bool:
    """Return whether the output holds the answer already and nothing is to be written; a dataset's root too is known."""
    root = store.roots.get(request.output.absolute())
    if root is None:
        return False
    if request.single_file:
        known = root["manifest"] == bytes_digest(hit.content) and request.output.exists()
        return known and file_digest(request.output) == hit.files[_single(request, hit)]["digest"]
    wanted = settled(store, request, hit)
    known = root["manifest"] == bytes_digest(wanted.content) and store.has(root["manifest"])
    return known and directory.shown(store, wanted, request.output.absolute())


def settled(store: Store, request: Request, made: Manifest) -> Manifest:
    """Return the manifest that the output shows after the command gave ``made``.

    Recordings have the labels that were set on them by hand, also where they were deleted or replaced in the meantime and
    come back; ingested ones are appended to those that are there. Raises `DamagedError` if what is there cannot be read.
    """
    if not made.recorded:
        return made
    before = replacing.occupant(store, request.output)
    if before is not None and before.stage != made.stage:
        before = None
    returning = replacing.returning_labels(store, request.output, before, made)
    if before is None:
        return _labelled(made, returning)
    if replacing.irreplaceable(made) and not request.replace:
        made = replacing.appended(before, made)
    return _labelled(made, {**returning, **before.labels})


def _labelled(made: Manifest, labels: Mapping[str, Mapping[str, Attribute]]) -> Manifest:
    return made.labelled(labels) if labels else made


def check(store: Store, request: Request, made: Manifest) -> None:
    """Raise `WouldChangeError` where the output was made from anything else, `UsageError` where it would be refused."""
    if not (request.single_file or request.replace):
        replacing.refuse_losses(_occupant(store, request), request.output, made)
    root = store.roots.get(request.output.absolute())
    if root is None or root["manifest"] != bytes_digest(made.content):
        raise WouldChangeError(f"{request.output} would change: it was made from other inputs or params.")


def publish(store: Store, request: Request, made: Manifest) -> Manifest:
    """Return the manifest that the output shows now."""
    if request.single_file:
        _publish_file(store, request, made)
        return made
    if not made.recorded and directory.shown(store, made, request.output.absolute()):
        store.roots.set(request.output.absolute(), bytes_digest(made.content))
        return made
    with directory.changing(store, request.output):  # somebody may be about to label what is there
        made = settled(store, request, made)
        if not request.replace:
            replacing.refuse_losses(_occupant(store, request), request.output, made)
        if made.recorded:
            store.put(made.content, durable=True)
        directory.publish_alone(store, made, request.output)
    return made


def refuse(store: Store, request: Request, plan: replacing.Plan) -> None:
    """Raise `UsageError` if the command would replace what it must not, before it computes anything."""
    if request.single_file:
        _refuse_file(store, request)
        return
    directory.check_output(store, request.output)
    if not request.replace:
        replacing.refuse_plan(_occupant(store, request), request.output, plan)


def _occupant(store: Store, request: Request) -> Manifest | None:
    """Return the manifest at the output; None also where both it and its root are damaged.

    Recordings are not written there then, as `settled` says; what is computed from others is computed again.
    """
    try:
        return replacing.occupant(store, request.output)
    except DamagedError:
        return None


def _refuse_file(store: Store, request: Request) -> None:
    output = request.output.absolute()
    if request.replace or not output.is_file() or store.roots.get(output) is not None:
        return
    if not store.has(file_digest(output)):
        raise UsageError(f"{request.output} is a file that tacpipe did not write. Give -o another name, or --replace.")


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
