"""A stage run from Python: what `tacpipe.run` was given as the request of a command, and what it made, opened."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

from tacpipe.datasets.dataset import Dataset
from tacpipe.engine import pipeline
from tacpipe.engine.request import OPTIONS, Request
from tacpipe.errors import ResultWarning, UsageError
from tacpipe.io import progress
from tacpipe.plugins import fields, given_params, registry
from tacpipe.plugins.stage import AnyStage
from tacpipe.training.devices import AUTO, Device

Given = str | PathLike[str] | Dataset
_STACK = 3  # frames from a warning to who called `tacpipe.run`


@dataclass(frozen=True)
class How:
    """The arguments of `tacpipe.run` that name no dataset."""

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
    named: Mapping[str, Given],
    params: Mapping[str, Any],
    how: How,
) -> Dataset | Path:
    """Run stage ``name`` and return its output: see `tacpipe.run`, whose arguments these are."""
    stage = registry.load(name)
    for flag, kind in OPTIONS.items():
        fields.check(getattr(how, flag), kind, flag)
    _refuse_unread(name, stage, datasets, named, how)
    paths: dict[str, Any] = {key: _path(given) for key, given in named.items()}
    read = [_path(given) for given in datasets]
    request = Request(
        name,
        given_params.build(
            name,
            stage,
            file=None if how.params_file is None else Path(how.params_file),
            block=how.block,
            preset=how.preset,
            options=params,
        ),
        Path(output),
        datasets=[] if stage.source else read,
        source=read[0] if stage.source else None,
        fold=how.fold,
        role=how.role,
        jobs=how.jobs,
        executor=how.executor,
        device=how.device,
        skip_bad=how.skip_bad,
        rerun=how.rerun,
        replace=how.replace,
        track=tuple(how.track),
        **paths,
    )
    with progress.showing_progress(how.progress):
        outcome = pipeline.run(request)
    for note in outcome.notes:
        warnings.warn(note, ResultWarning, stacklevel=_STACK)
    for recording, why in outcome.bad.items():
        warnings.warn(f"left out {recording}: {why}", ResultWarning, stacklevel=_STACK)
    return request.output if request.single_file else pipeline.open_dataset(request.output)


def _refuse_unread(name: str, stage: AnyStage, datasets: Sequence[Given], named: Mapping[str, Given], how: How) -> None:
    """Raise `UsageError` for an argument that the stage does not read, and for datasets too few or too many."""
    kinds = set(stage.arguments.values())
    reads = {
        "model": stage.reads_model,
        "split": stage.reads_split,
        "codec": stage.fit is not None,
        "init": "init" in stage.arguments,
        "extend": "extend" in stage.arguments,
    }
    is_set = {**dict.fromkeys(named, True), "fold": how.fold != 0, "role": how.role is not None}
    is_set |= {"track": bool(how.track), "device": how.device != AUTO}
    reads |= {"fold": reads["split"], "role": stage.reads_model and not stage.needs_split, "track": stage.tracked}
    reads |= {"device": stage.trains}
    for key in is_set:
        if is_set[key] and not reads[key]:
            raise UsageError(f"The stage {name} does not read {key}; leave it out.")
    if stage.source and len(datasets) != 1:
        raise UsageError(f"The stage {name} reads one folder of recordings, not {len(datasets)}.")
    if datasets and not stage.source and not kinds & {"Recording", "Dataset", "Datasets"}:
        raise UsageError(f"The stage {name} reads no dataset; leave {datasets[0]} out.")


def _path(given: Given) -> Path:
    """Return where a dataset lies. Raises `UsageError` for one that is nowhere, or of which a part was selected."""
    if not isinstance(given, Dataset):
        return Path(given)
    if given.path is None:
        raise UsageError("A dataset that a stage was given has no path; give one that tacpipe.open returned.")
    if len(given) < len(given.source.included):
        raise UsageError(
            f"A stage reads whole datasets, and {len(given)} of the {len(given.source.included)} recordings of {given.path} "
            f"were selected. Give the path, and a split for the roles of recordings."
        )
    return given.path
