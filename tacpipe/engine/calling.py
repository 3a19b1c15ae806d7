"""Run a stage from Python: turn the arguments of `tacpipe.run` into a request, and open its output."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

from tacpipe.datasets.dataset import Dataset
from tacpipe.engine import pipeline
from tacpipe.engine.request import OPTIONS, Request
from tacpipe.errors import ResultWarning, UsageError
from tacpipe.io import terminal
from tacpipe.plugins import fields, given_params, registry
from tacpipe.plugins.stage import AnyStage, Values
from tacpipe.training.devices import AUTO, Device

Given = str | PathLike[str] | Dataset
_STACK = 3  # stack frames from a warning to the caller of `tacpipe.run`


@dataclass(frozen=True)
class How:
    """The arguments of `tacpipe.run` that are not datasets."""

    fold: int = 0
    role: str | None = None
    preset: str | None = None
    params_file: str | PathLike[str] | None = None
    block: str | None = None
    jobs: int = 0
    executor: str = ""
    device: Device = AUTO
    skip_bad: bool = False
    rerun: bool = False
    replace: bool = False
    progress: bool = False
    track: Sequence[str] = ()


def call(
    name: str,
    datasets: Sequence[Given],
    output: str | PathLike[str],
    arguments: Mapping[str, Given],
    params: Values,
    options: How,
) -> Dataset | Path:
    """Run stage ``name`` and return its output; see `tacpipe.run` for the arguments."""
    stage = registry.load(name)
    for flag, kind in OPTIONS.items():
        fields.check(getattr(options, flag), kind, flag)
    _refuse_unread(name, stage, datasets, arguments, options)
    paths = {key: _path(dataset) for key, dataset in arguments.items()}
    dataset_paths = [_path(dataset) for dataset in datasets]
    request = Request(
        name,
        given_params.build(
            name,
            stage,
            file=None if options.params_file is None else Path(options.params_file),
            block=options.block,
            preset=options.preset,
            options=params,
        ),
        Path(output),
        datasets=[] if stage.source else dataset_paths,
        source=dataset_paths[0] if stage.source else None,
        fold=options.fold,
        role=options.role,
        jobs=options.jobs,
        executor=options.executor,
        device=options.device,
        skip_bad=options.skip_bad,
        rerun=options.rerun,
        replace=options.replace,
        track=tuple(options.track),
    ).with_paths(paths)
    with terminal.showing_progress(options.progress):
        outcome = pipeline.run(request)
    for note in outcome.notes:
        warnings.warn(note, ResultWarning, stacklevel=_STACK)
    for recording, reason in outcome.bad.items():
        warnings.warn(f"left out {recording}: {reason}", ResultWarning, stacklevel=_STACK)
    return request.output if request.single_file else pipeline.open_dataset(request.output)


def _refuse_unread(
    name: str, stage: AnyStage, datasets: Sequence[Given], arguments: Mapping[str, Given], options: How
) -> None:
    """Raise `UsageError` for arguments that the stage does not read, and for a wrong number of datasets."""
    kinds = set(stage.arguments.values())
    reads = {
        "model": stage.reads_model,
        "split": stage.reads_split,
        "codec": stage.fit is not None,
        "init": "init" in stage.arguments,
        "extend": "extend" in stage.arguments,
    }
    is_set = {**dict.fromkeys(arguments, True), "fold": options.fold != 0, "role": options.role is not None}
    is_set |= {"track": bool(options.track), "device": options.device != AUTO}
    reads |= {"fold": reads["split"], "role": stage.reads_model and not stage.needs_split, "track": stage.tracked}
    reads |= {"device": stage.trains}
    for key in is_set:
        if is_set[key] and not reads[key]:
            raise UsageError(f"The stage {name} does not read {key}; leave it out.")
    if stage.source and len(datasets) != 1:
        raise UsageError(f"The stage {name} reads one folder of recordings, not {len(datasets)}.")
    if datasets and not stage.source and not kinds & {"Recording", "Dataset", "Datasets"}:
        raise UsageError(f"The stage {name} reads no dataset; leave {datasets[0]} out.")


def _path(dataset: Given) -> Path:
    """Return the path of a dataset. Raises `UsageError` if it has none or is a selection of recordings."""
    if not isinstance(dataset, Dataset):
        return Path(dataset)
    if dataset.path is None:
        raise UsageError("A dataset that a stage was given has no path; give one that tacpipe.open returned.")
    if len(dataset) < len(dataset.source.included):
        raise UsageError(
            f"A stage reads whole datasets, and {len(dataset)} of the {len(dataset.source.included)} recordings of "
            f"{dataset.path} were selected. Give the path, and a split for the roles of recordings."
        )
    return dataset.path
