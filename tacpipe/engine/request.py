"""What a command was asked for, and the datasets, model, split and source files that it reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from tacpipe.datasets import manifest, recording_names
from tacpipe.datasets.manifest import Entry, Found, Manifest
from tacpipe.datasets.replacing import Plan
from tacpipe.engine import execution
from tacpipe.errors import UsageError
from tacpipe.io.hashing import remembered_file_digest
from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tacpipe.plugins.stage import Stage
from tacpipe.store.store import Store


@dataclass(frozen=True)
class Request:
    """What a command was asked to do."""

    name: str  # of the stage
    params: Any
    output: Path
    datasets: Sequence[Path] = ()
    model: Path | None = None
    source: Path | None = None
    split: Path | None = None
    fold: int = 0
    role: str | None = None
    codec: Path | None = None
    extend: Path | None = None
    init: Path | None = None
    jobs: int = 0
    skip_bad: bool = False
    check: bool = False
    compare: bool = False
    rerun: bool = False  # compute what is stored too, and store what comes out
    replace: bool = False  # the output may hold another stage's dataset, or recordings and labels that will go

    @property
    def single_file(self) -> bool:
        """Whether the output is one file, such as a report, and no dataset directory."""
        return self.output.suffix == ".html"


class Inputs:
    """All that a request reads."""

    def __init__(self, request: Request, store: Store) -> None:
        self.request, self.store = request, store
        self.stage = registry.load(request.name)
        self.datasets = [manifest.find(path) for path in request.datasets]
        self.named: dict[str, Found] = {
            name: manifest.find(path)
            for name in ("model", "split", "codec", "extend", "init")
            if (path := getattr(request, name)) is not None
        }
        self.notes: list[str] = []  # what the user should know though nothing failed
        self.sources = _discover(self.stage, request)
        self.source_digests = _hash(self.sources)

    def identity(self) -> dict[str, Any]:
        """Return what names the run: manifests read, params, versions. It answers a rerun without opening a shard."""
        fit = self.stage.fit
        return {
            "run": self.request.name,
            "version": [self.stage.version, fit.version if fit else None],
            "params": params_of.to_json(self.request.params),
            "datasets": [found.digest for found in self.datasets],
            "named": {name: found.digest for name, found in self.named.items()},
            "sources": self.source_digests,
            "fold": self.request.fold,
            "role": self.request.role,
        }

    def plan(self) -> Plan:
        """Return what is known of the result before anything is computed."""
        return Plan(
            self.request.name, self.stage.version, params_of.to_json(self.request.params), dict(self.source_digests)
        )

    def lineage(self) -> dict[str, list[dict[str, str]]]:
        """Return the inputs as a manifest names them."""
        given = {"datasets": self.datasets, **{name: [found] for name, found in self.named.items()}}
        return {
            name: [{"dataset": found.manifest.digest, "manifest": found.digest} for found in several]
            for name, several in given.items()
            if several
        }

    @property
    def used(self) -> list[Found]:
        """All datasets that were given."""
        return [*self.datasets, *self.named.values()]

    @property
    def beside(self) -> tuple[str, ...]:
        """The directories of all given datasets."""
        return tuple(str(found.directory.absolute()) for found in self.used)

    @cached_property
    def merged(self) -> Manifest:
        """The given datasets read as one."""
        if not self.datasets:
            raise UsageError(f"{self.request.name} needs a dataset to read.")
        return manifest.merge([found.manifest for found in self.datasets])

    @property
    def model(self) -> Manifest:
        """The given model's manifest."""
        if "model" not in self.named:
            raise UsageError(f"{self.request.name} needs a model to read.")
        return self.named["model"].manifest

    @cached_property
    def roles(self) -> dict[str, str]:
        """Recording to role in the fold that was asked for."""
        split = self.named.get("split")
        if split is None:
            raise UsageError(
                f"{self.request.name} must know which recordings to train on: give --split, as made by `tacpipe split`."
            )
        read_content = execution.reader(self.store, (str(split.directory),))
        table = execution.read_roles(read_content(split_digest(split), "split.parquet"))
        folds = sorted({fold for _, fold in table})
        fold = self.request.fold
        if fold not in folds:
            raise UsageError(f"The split {split.directory} has the folds {folds}; --fold {fold} is none.")
        return {recording: role for (recording, number), role in table.items() if number == fold}

    def in_role(self, given: Manifest, role: str, *, may_lack: bool = False) -> dict[str, Entry]:
        """Return the recordings of ``given`` that have this role. Raises `UsageError` without any, unless ``may_lack``."""
        chosen = {name: entry for name, entry in given.included.items() if self.roles.get(name) == role}
        unknown = sorted(set(given.included) - set(self.roles))
        if unknown:
            note = f"{len(unknown)} recordings have no role in the split and are left out, as {unknown[0]}"
            self.notes.append(f"{note}: give them one with `tacpipe split --extend`.")
        if not chosen and not may_lack:
            raise UsageError(
                f"No recording of the dataset has the role {role} in fold {self.request.fold} of the split. "
                f"Split this dataset, or give the split that was made for it."
            )
        return chosen


def split_digest(split: Found) -> str:
    """Return the digest of the table of a split."""
    recordings = split.manifest.recordings
    if set(recordings) != {"split"}:
        raise UsageError(f"{split.directory} is not a split; make one with `tacpipe split`.")
    found: str = recordings["split"]["shards"][""]["digest"]
    return found


def _discover(stage: Stage, request: Request) -> dict[str, dict[str, Path]]:
    if not stage.source:
        return {}
    if request.source is None or stage.discover is None:
        raise UsageError(f"{request.name} needs a folder of recordings to read.")
    if not request.source.exists():
        raise UsageError(f"There is no {request.source} to read recordings from.")
    found = {name: dict(files) for name, files in sorted(stage.discover(request.params, request.source).items())}
    recording_names.refuse_shared((name, next(iter(files.values()), request.source)) for name, files in found.items())
    return found


def _hash(sources: Mapping[str, Mapping[str, Path]]) -> dict[str, dict[str, str]]:
    """Return the digest of each file; threads were tried and gain nothing on files of some 100 kB."""
    return {
        name: {file: remembered_file_digest(path) for file, path in files.items()} for name, files in sources.items()
    }
