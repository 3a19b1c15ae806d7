"""Publish the output of a command: a dataset with its labels, or one file."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

from tacpipe.datasets import directory, pages, replacing
from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets.delivery import deliver
from tacpipe.datasets.manifest import Manifest
from tacpipe.engine import previous as previous_of
from tacpipe.engine.previous import Previous
from tacpipe.engine.request import Request
from tacpipe.errors import DamagedError, TacpipeError, UsageError, WouldChangeError
from tacpipe.io.hashing import file_digest
from tacpipe.plugins.stage import Attribute
from tacpipe.store import presence
from tacpipe.store.presence import Head, Look, Note
from tacpipe.store.roots import Root
from tacpipe.store.store import MissingError, Store


@dataclass(frozen=True)
class Unread:
    """A result that is already shown according to a note, so that its manifest is not read."""

    rows: int


class CommandSource(Protocol):
    """The source of a command's result."""

    @property
    def key(self) -> str:
        """The key of the run."""

    def count(self, manifest: Manifest) -> int:
        """Return the number of stored results that a manifest consists of."""

    def recall(self, manifest_digest: str, reused: int) -> bool:
        """Restore the outcome of an earlier run; return whether it produced the manifest with this digest."""

    @property
    def reads(self) -> Sequence[str]:
        """The digests of the manifests that the result is computed from."""

    def answer(self) -> Manifest | None:
        """Return the result if it is completely stored, else None. Runs nothing."""

    def make(self) -> Manifest:
        """Compute what is missing and return the result. The run is not recorded."""

    def result(self, *, rerun: bool, previous: Previous | None = None) -> Manifest:
        """Return the stored result, or compute and record it; with ``rerun``, always compute it.

        Unchanged parts of a ``previous`` run are reused.
        """


def settle(store: Store, request: Request, plan: replacing.ResultPlan, work: CommandSource) -> Manifest | Unread:
    """Return the manifest that the output shows after the request. Commands write their output only through this.

    If a valid note states that the output already shows the stored result, its manifest is not read.

    ===============  ==================================  ==============================================
    output           ``--check``                         otherwise
    ===============  ==================================  ==============================================
    shows the result  nothing to do                       nothing to do
    shows another     raises `WouldChangeError`           the stored or computed result is published
    must not change   raises `UsageError`                 raises `UsageError`, before anything is run
    ===============  ==================================  ==============================================

    With ``--recompute-and-compare`` the result is computed and the output is not changed. Until the result is
    published, its inputs are not collected. If an object turns out to be damaged when it is linked, the result is
    recomputed.
    """
    target = _output_place(store, request)
    if (unread := target.unread(work)) is not None:
        return unread
    directory_look = target.look()
    stored = None if request.compare or request.rerun else work.answer()
    is_shown = stored is not None and target.shows(stored, directory_look)
    if is_shown and stored is not None:
        target.note(directory_look, work, stored)
    if not (is_shown or request.compare):
        target.refuse(plan)
    if is_shown or request.check or request.compare:
        manifest = target.settled(stored or work.make())
        if request.check:
            target.check(manifest)
        return manifest
    with store.at_work([*work.reads, *target.source_manifests]):
        previous = None if request.rerun else target.previous()
        result: Manifest | None = None
        try:
            result = work.result(rerun=request.rerun, previous=previous)
            return target.published(work, result, previous)
        except MissingError:  # linking detected a damaged object: recompute all damaged objects
            if result is not None:
                _quarantine_damaged(store, result)
            return target.published(work, work.result(rerun=False))


def _quarantine_damaged(store: Store, manifest: Manifest) -> None:
    """Read all objects of a dataset, so that damaged ones are quarantined and count as missing."""
    for name, size in dict(manifest.sizes()).items():
        with suppress(MissingError):
            for _ in store.blocks(name, size):
                pass


def _output_place(store: Store, request: Request) -> _Place:
    return _File(store, request) if request.single_file else _Directory(store, request)


class _Place(ABC):
    """The output of a request."""

    def __init__(self, store: Store, request: Request) -> None:
        self.store, self.request, self.path = store, request, request.output.absolute()

    @property
    def root(self) -> Root | None:
        """The root in the store: the last dataset written to this output, or None."""
        return self.store.roots.get(self.path)

    @abstractmethod
    def shows(self, hit: Manifest, look: Look | None) -> bool:
        """Return whether the output and its root already show the result. Adds the files to ``look``."""

    def unread(self, work: CommandSource) -> Unread | None:
        """Return the result without reading it, if a valid note states that it is completely shown; else None."""
        return None

    def look(self) -> Look | None:
        """Return a new look at all files, or None if its findings would not be noted."""
        return None

    def note(self, look: Look | None, work: CommandSource, hit: Manifest) -> bool:
        """Note that the look found the whole result; return whether the note was written."""
        return False

    @property
    def source_manifests(self) -> list[str]:
        """The digests of manifests whose results may be reused."""
        return []

    def previous(self) -> Previous | None:
        """Return the run that produced the shown result, if a note describes it and all of it still exists."""
        return None

    def published(self, work: CommandSource, result: Manifest, previous: Previous | None = None) -> Manifest:
        """Publish ``result``, which may reuse parts of a ``previous`` run, and return the published manifest."""
        return self.publish(result)

    @abstractmethod
    def refuse(self, plan: replacing.ResultPlan) -> None:
        """Raise `UsageError` before anything is computed if the command would replace a protected output."""

    @abstractmethod
    def publish(self, result: Manifest) -> Manifest:
        """Publish ``result`` and return the published manifest."""

    def settled(self, result: Manifest) -> Manifest:
        """Return the manifest to publish for ``result``."""
        return result

    def check(self, result: Manifest) -> None:
        """Raise `WouldChangeError` if the output was computed from other inputs, `UsageError` if it is protected."""
        root = self.root
        if root is None or root["manifest"] != result.content_digest:
            raise WouldChangeError(f"{self.request.output} would change: it was made from other inputs or params.")


class _Directory(_Place):
    """The directory of a dataset."""

    _linked = False  # whether the directory contains only links to objects

    def shows(self, stored: Manifest, look: Look | None) -> bool:
        """Return whether the directory shows ``hit``. Sets ``_linked`` to whether it contains only links to objects."""
        root = self.root
        if root is None:
            return False
        expected = self.settled(stored)
        is_current = root["manifest"] == expected.content_digest and self.store.has(root["manifest"])
        self._linked = False
        if not is_current:
            return False
        if look is not None:
            look.begin()
        appearance = directory.showing(self.store, expected, self.path)
        self._linked = appearance == "links"
        return bool(appearance)

    @cached_property
    def _valid_note(self) -> Note | None:
        """The note about this directory, if it describes the manifest shown here."""
        note, root = presence.read_note(self.store, self.path), self.root
        if note is None or root is None or root["manifest"] != note.head.manifest:
            return None
        with suppress(OSError, TacpipeError):
            if manifest_of.find(self.path).digest == note.head.manifest:
                return note
        return None

    def unread(self, work: CommandSource) -> Unread | None:
        """Return a substitute for the manifest if a note shows that the directory has the result of ``work``, else None."""
        request = self.request
        if request.compare or request.rerun or request.track or request.check:
            return None
        note = self._valid_note
        if note is None or note.head.key != work.key:
            return None
        with suppress(OSError, TacpipeError):
            if Look(self.store, self.path).holds(note) and work.recall(note.head.manifest, note.head.reused):
                return Unread(note.head.rows)
        return None

    def look(self) -> Look | None:
        with suppress(OSError, TacpipeError):
            if len(manifest_of.find(self.path).manifest.recordings) > pages.INLINE:
                return Look(self.store, self.path)
        return None

    def note(self, look: Look | None, work: CommandSource, hit: Manifest) -> bool:
        if look is None or hit.copied or not self._linked:
            return False
        return look.note(_head(work, hit), hit.contents())

    @property
    def source_manifests(self) -> list[str]:
        """Return the manifest that the directory shows and its inputs, by digest; an empty list without a valid note."""
        return (
            []
            if self._valid_note is None
            else [self._valid_note.head.manifest, *previous_of.inputs(self.store, self._valid_note)]
        )

    def previous(self) -> Previous | None:
        return None if self._valid_note is None else previous_of.find(self.store, self.path, self._valid_note)

    def published(self, work: CommandSource, result: Manifest, previous: Previous | None = None) -> Manifest:
        """Publish ``result``, and note that the directory is complete, so that the next check is fast.

        Return what it shows.
        """
        published = self.publish(result, previous, work.key)
        if result.copied or published.pages is None:
            return published
        head = _head(work, published)
        if previous is not None and previous.succeed(head, published):
            return published
        look = Look(self.store, self.path)
        look.begin()
        appearance = directory.showing(self.store, published, self.path)
        if appearance == "links":
            look.note(head, published.contents())
        elif not appearance:  # an existing file of the same size has other content
            directory.publish(self.store, published, self.path)
        return published

    def refuse(self, plan: replacing.ResultPlan) -> None:
        directory.check_output(self.store, self.request.output)
        if not self.request.replace:
            replacing.refuse_plan(self._occupant(), self.request.output, plan)

    def settled(self, result: Manifest) -> Manifest:
        """Return ``result`` in its published form.

        Recordings keep the labels that were set by hand, even if they were deleted or replaced in between. Ingested
        recordings are appended to the existing ones. Raises `DamagedError` if the existing dataset cannot be read.
        """
        if not result.recorded:
            return result
        existing = replacing.occupant(self.store, self.request.output)
        if existing is not None and existing.stage != result.stage:
            existing = None
        returning_labels = replacing.returning_labels(self.store, self.request.output, existing, result)
        if existing is None:
            return _with_labels(result, returning_labels)
        appends = replacing.irreplaceable(result) and not self.request.replace
        return _with_labels(
            replacing.append_manifest(existing, result) if appends else result, {**returning_labels, **existing.labels}
        )

    def check(self, result: Manifest) -> None:
        """Raise an error if publishing ``result`` would change the directory, or lose something that was edited by hand."""
        self._refuse_losses(result)
        edited = directory.edited_files(self.store, result, self.path) if result.exported else []
        if edited and not self.request.replace:
            raise replacing.edited_files_error(self.request.output, edited)
        super().check(result)

    def publish(self, result: Manifest, previous: Previous | None = None, key: str = "") -> Manifest:
        """Publish ``result`` in the directory, record it as the root, and return the manifest in its published form."""
        if not result.recorded and directory.shows(self.store, result, self.path):
            deliver(self.store, self.path, result)
            self.store.roots.set(self.path, result.content_digest, key=key)
            return result

        def decide_change() -> directory.DirectoryChange:  # labels may have been set in the meantime
            settled = self.settled(result)
            self._refuse_losses(settled)
            complete = previous is not None and previous.is_current()
            return directory.DirectoryChange(settled, is_complete=complete, replace=self.request.replace, key=key)

        return directory.change(self.store, self.request.output, decide_change)

    def _refuse_losses(self, result: Manifest) -> None:
        if not self.request.replace:
            replacing.refuse_losses(self._occupant(), self.request.output, result)

    def _occupant(self) -> Manifest | None:
        """Return the manifest in the directory, or None if there is none or both it and its root are damaged.

        Then recordings are not written there, as `settled` states; results computed from others are computed again.
        """
        try:
            return replacing.occupant(self.store, self.request.output)
        except DamagedError:
            return None


class _File(_Place):
    """A single file of a result, written in place of a dataset."""

    def shows(self, hit: Manifest, look: Look | None) -> bool:
        root = self.root
        is_current = root is not None and root["manifest"] == hit.content_digest and self.path.exists()
        return is_current and file_digest(self.path) == self._digest(hit)

    def refuse(self, plan: replacing.ResultPlan) -> None:
        """Raise `UsageError` for a file that tacpipe did not write, unless it may be replaced."""
        if self.request.replace or not self.path.is_file() or self.root is not None:
            return
        if not self.store.has(file_digest(self.path)):
            raise UsageError(
                f"{self.request.output} is a file that tacpipe did not write. Give -o another name, or --replace."
            )

    def publish(self, result: Manifest) -> Manifest:
        """Copy the requested file of ``result`` to the output, and record it as the root of that path."""
        file_name = self._digest(result)
        with directory.changing(self.store, self.path), directory.writing(self.path):
            if not self.path.exists() or file_digest(self.path) != file_name:
                directory.sweep_beside(self.path)
                directory.place(self.store, file_name, self.path, copy=True)
            deliver(self.store, self.path, result)
            self.store.roots.set(self.path, result.content_digest)
        return result

    def _digest(self, result: Manifest) -> str:
        """Return the digest of the file with the output's suffix. Raises `UsageError` if the result has none."""
        suffix = self.path.suffix
        matching = next((file["digest"] for name, file in result.files.items() if name.endswith(suffix)), None)
        if matching is None:
            raise UsageError(f"{self.request.name} makes no {suffix} file; give -o a directory.")
        return str(matching)


def _with_labels(result: Manifest, labels: Mapping[str, Mapping[str, Attribute]]) -> Manifest:
    return result.labelled(labels) if labels else result


def _head(work: CommandSource, result: Manifest) -> Head:
    return Head(work.key, result.content_digest, work.count(result), result.rows)
