"""Describe the request of a command, and find the datasets, model, split and source files that it reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from tacpipe.datasets import manifest, pages, paths, selection
from tacpipe.datasets.manifest import VALUES, Found, InputDataset, Manifest
from tacpipe.datasets.replacing import ResultPlan
from tacpipe.engine import execution
from tacpipe.errors import UsageError
from tacpipe.io import regular
from tacpipe.io.hashing import digest, remembered_file_digest
from tacpipe.plugins import failures, registry
from tacpipe.plugins import params as params_of
from tacpipe.plugins.constraints import NonNegativeInt
from tacpipe.plugins.stage import AnyStage, Source
from tacpipe.store.records import RecordingEntry, RunIdentity
from tacpipe.store.store import Store
from tacpipe.training.devices import AUTO, Device

# types of the options of a run that are not params
OPTIONS = {
    "jobs": NonNegativeInt,
    "executor": str,
    "device": Device,
    "fold": NonNegativeInt,
    "role": Literal["train", "val", "calibration", "test"] | None,
}


DATASETS = ("model", "split", "codec", "extend", "init")  # options that name a dataset
_MODEL, _RESULT = "config.json", "metrics.json"  # files of a model, and of an evaluation, which has both
PATHS = (*DATASETS, "source")


@dataclass(frozen=True)
class Request:
    """The request of a command."""

    name: str  # name of the stage
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
    executor: str = ""  # NAME or NAME://ADDRESS; empty for the environment's executor, or this computer
    device: Device = AUTO  # device for training networks
    skip_bad: bool = False
    check: bool = False
    compare: bool = False
    rerun: bool = False  # whether to compute stored results again and store the new ones
    track: Sequence[str] = ()  # trackers that follow the training, as ``NAME`` or ``NAME:PLACE``
    replace: bool = False  # whether the output may replace another stage's dataset, or recordings and labels

    @property
    def reads(self) -> list[Path]:
        """All paths to read: datasets, model, split and the like, and the folder of a published source."""
        return [*self.datasets, *self.named_paths.values()]

    @property
    def named_paths(self) -> dict[str, Path]:
        """Paths to read by argument name, without the datasets."""
        return {name: path for name in PATHS if (path := getattr(self, name)) is not None}

    def with_paths(self, paths: Mapping[str, Path | None]) -> Request:
        """Return the request with these paths to read, by argument name."""
        fields: Any = paths
        return replace(self, **fields)

    @property
    def locations(self) -> list[Path]:
        """Return the paths where the store is searched: the output, then the input datasets."""
        return [self.output, *self.datasets, *(path for name, path in self.named_paths.items() if name in DATASETS)]

    @property
    def single_file(self) -> bool:
        """Whether the output is one file, such as a report, instead of a dataset directory."""
        return self.output.suffix == ".html"


class RequestInputs:
    """Everything that a request reads."""

    def __init__(self, request: Request, store: Store) -> None:
        self.request, self.store = request, store
        self.stage = registry.load(request.name)
        self.datasets = [manifest.find(path) for path in request.datasets]
        self.named_datasets: dict[str, Found] = {
            name: manifest.find(path) for name, path in request.named_paths.items() if name in DATASETS
        }
        self.request = _with_group_of_split(request, self.named_datasets.get("split"))
        self.notes: list[str] = []  # warnings for the user
        self.sources = _discover_sources(self.stage, request)
        self.source_digests = _hash_sources(self.sources)

    def identity(self) -> RunIdentity:
        """Return the identity of the run: manifests, params, versions.

        A rerun is answered from it without opening a shard.
        """
        fit = self.stage.fit
        identity: RunIdentity = {
            "run": self.request.name,
            "version": [self.stage.version, fit.version if fit else None],
            "params": params_of.to_json(self.request.params),
            "datasets": [dataset.digest for dataset in self.datasets],
            "named": {name: dataset.digest for name, dataset in self.named_datasets.items()},
            "sources": self.source_digests,
            "fold": self.request.fold,
            "role": self.request.role,
        }
        if self.equal_recordings:
            identity["equal"] = self.equal_recordings
        return identity

    @cached_property
    def equal_recordings(self) -> Sequence[Sequence[str]]:
        """Groups of recordings with equal content, if the stage must not separate them and would; else none.

        They are part of a key only then, so other keys stay as they are.
        """
        separated = getattr(self.request.params, "separated", None)
        groups = selection.equal_recordings(self.merged.included) if separated is not None else []
        if not groups or separated is None:
            return []
        attributes = {
            name: entry["attributes"] for part in pages.parts(self.merged.included) for name, entry in part.items()
        }
        older = self.named_datasets.get("extend")
        return groups if separated(attributes, {} if older is None else self._read_roles(older), groups) else []

    def describe_unread(self) -> list[str]:
        """Return sentences about files below the source that are not part of a recording."""
        if self.request.source is None or not self.sources:
            return []
        read_paths = {path for source in self.sources.values() for path in source.files.values()}
        assert self.stage.source is not None
        why_unread = self.stage.source.why_unread
        if why_unread is not None:
            reason = why_unread(self.request.params, self.request.source)
        else:
            command = self.request.name.replace(".", " ")
            reason = f"`tacpipe {command}` reads no recording from it".format  # the reason is the same for any path
        from tacpipe.formats import container

        return container.describe_unread(self.request.source, read_paths, reason, self.request.output)

    def describe_findings(self) -> list[str]:
        """Return at most one line on labels and equal recordings that concern a training or an evaluation."""
        trains = self.request.name.startswith(registry.PREFIXES[registry.TASKS])
        if not trains and not (self.stage.reads_model and self.stage.headline):
            return []
        from tacpipe.checks import roles

        requirements = registry.requirements(self.request.name if trains else self.model.stage)
        labels = {label.name for label in requirements.labels} if requirements else set()
        labels |= {getattr(self.request.params, "label", "")}
        recordings = self.merged.included
        equal = selection.equal_recordings(recordings) if "split" in self.named_datasets else []
        attributes = {name: entry["attributes"] for part in pages.parts(recordings) for name, entry in part.items()}
        sentence = roles.describe(attributes, sorted(labels), equal, self.roles if equal else {})
        return [sentence] if sentence else []

    def plan(self) -> ResultPlan:
        """Return the properties of the result that are known before it is computed."""
        return ResultPlan(
            self.request.name, self.stage.version, params_of.to_json(self.request.params), dict(self.source_digests)
        )

    def lineage(self) -> dict[str, list[InputDataset]]:
        """Return the inputs as a manifest lists them."""
        inputs = {"datasets": self.datasets, **{name: [dataset] for name, dataset in self.named_datasets.items()}}
        return {
            name: [{"dataset": dataset.manifest.digest, "manifest": dataset.digest} for dataset in datasets]
            for name, datasets in inputs.items()
            if datasets
        }

    @property
    def used(self) -> list[Found]:
        """All input datasets."""
        return [*self.datasets, *self.named_datasets.values()]

    @property
    def dataset_dirs(self) -> tuple[str, ...]:
        """Directories of all input datasets, from which shards can be adopted."""
        return tuple(str(dataset.directory.absolute()) for dataset in self.used)

    @cached_property
    def merged(self) -> Manifest:
        """The input datasets merged into one. Raises `UsageError` if there are none."""
        if not self.datasets:
            raise UsageError(f"{self.request.name} needs a dataset to read.")
        return selection.merge_manifests([dataset.manifest for dataset in self.datasets])

    @property
    def model(self) -> Manifest:
        """The manifest of the input model. Raises `UsageError` if the dataset is not a model."""
        if "model" not in self.named_datasets:
            raise UsageError(f"{self.request.name} needs a model to read.")
        return _model_manifest(self.named_datasets["model"])

    @property
    def initial_model(self) -> Manifest | None:
        """The manifest of the initial model, if any. Raises `UsageError` if the dataset is not a model."""
        return _model_manifest(self.named_datasets["init"]) if "init" in self.named_datasets else None

    @cached_property
    def roles(self) -> dict[str, str]:
        """Role by recording in the requested fold. Raises `UsageError` if the stage needs a split and has none."""
        split = self.named_datasets.get("split")
        if split is None:
            raise UsageError(
                f"{self.request.name} must know which recordings to train on: give --split, as made by `tacpipe split`."
            )
        return selection.roles_in_fold(self._read_roles(split), self.request.fold, str(split.directory))

    def _read_roles(self, split: Found) -> dict[tuple[str, int], str]:
        """Return the role by (recording, fold) in a split. Raises `UsageError` for any other dataset."""
        place = str(split.directory)
        content = execution.reader(self.store, (place,))(
            selection.split_digest(split.manifest, place), selection.SPLIT_FILE
        )
        return selection.read_roles(content)

    def in_role(self, source: Manifest, role: str, *, may_lack: bool = False) -> dict[str, RecordingEntry]:
        """Return the recordings of ``source`` with this role. Raises `UsageError` if there are none, unless ``may_lack``."""
        chosen = {name: entry for name, entry in source.included.items() if self.roles.get(name) == role}
        unknown = sorted(set(source.included) - set(self.roles))
        if unknown:
            note = f"{len(unknown)} recordings have no role in the split and are left out, as {unknown[0]}"
            self.notes.append(f"{note}: give them one with `tacpipe split --extend`.")
        if not chosen and not may_lack:
            raise UsageError(
                f"No recording of the dataset has the role {role} in fold {self.request.fold} of the split. "
                f"Split this dataset, or give the split that was made for it."
            )
        return chosen


def _with_group_of_split(request: Request, split: Found | None) -> Request:
    """Return a request whose empty param ``group`` names the labels by which the split keeps recordings together."""
    if split is None or getattr(request.params, "group", None) != "":
        return request
    params = split.manifest.params
    group = params.get("group") or params.get("apart") or params.get("by")
    return replace(request, params=replace(request.params, group=str(group))) if group else request


def _model_manifest(dataset: Found) -> Manifest:
    """Return the manifest of a model. Raises `UsageError` if the dataset is not a model."""
    manifest = dataset.manifest
    if _MODEL not in manifest.files or _RESULT in manifest.files:
        raise UsageError(
            f"{dataset.directory} is not a model: {manifest.stage} made it. Give what `tacpipe train` or "
            f"`tacpipe calibrate` wrote with -o."
        )
    return manifest


def _discover_sources(stage: AnyStage, request: Request) -> dict[str, Source]:
    """Return the recordings that the stage finds in the source, by name; empty if it reads no source.

    Raises `UsageError` if the source is missing, and the errors of `paths.refuse_shared_names` and
    `regular.expect_inside`.
    """
    if stage.source is None:
        return {}
    if request.source is None:
        raise UsageError(f"{request.name} needs a folder of recordings to read.")
    if not request.source.exists():
        raise UsageError(f"There is no {request.source} to read recordings from.")
    with failures.naming_source([request.source]):
        discovered = stage.source.discover(request.params, request.source)
    sources = {
        name: source if isinstance(source, Source) else Source(source) for name, source in sorted(discovered.items())
    }
    paths.refuse_shared_names(
        (name, next(iter(source.files.values()), request.source)) for name, source in sources.items()
    )
    regular.expect_inside(request.source, (path for source in sources.values() for path in source.files.values()))
    return sources


def _hash_sources(sources: Mapping[str, Source]) -> dict[str, dict[str, str]]:
    """Return the digests of files and values by recording. Threads would not speed up files of about 100 kB."""
    return {
        name: {
            **{file: remembered_file_digest(path) for file, path in source.files.items()},
            **({VALUES: digest(dict(source.values))} if source.values else {}),
        }
        for name, source in sources.items()
    }
