"""Recordings that a model is to predict: opened datasets, behind the stages that the model was trained behind."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tacpipe.datasets.dataset import Dataset, Recording
from tacpipe.datasets.manifest import chain_difference
from tacpipe.errors import UsageError

Chain = Sequence[Mapping[str, Any]]  # of a manifest: the stages that recordings went through one by one


def opened(recordings: Dataset | Recording, chain: Chain | None) -> Dataset:
    """Return a dataset, or the one of a recording alone, that went through the stages ``chain``; None: not known.

    Raises `UsageError` for anything else, and where the stages are others.
    """
    if isinstance(recordings, Recording):
        recordings = recordings.alone
    if not isinstance(recordings, Dataset):
        raise UsageError(
            f"A {type(recordings).__name__} is not a dataset or a recording. Give tacpipe.open(PATH), or one of its shards."
        )
    if chain is not None:
        _check(chain, recordings.source.chain)
    return recordings


def _check(wanted: Chain, found: Chain) -> None:
    if list(found) == list(wanted):
        return
    if list(found) == list(wanted[: len(found)]):
        missing = ", then ".join(f"`tacpipe {_command(step)}`" for step in wanted[len(found) :])
        raise UsageError(
            f"These recordings did not go through all stages that the model was trained behind: {missing} is missing. Run "
            f"it, or use `tacpipe predict MODEL RECORDINGS -o OUTPUT`, which does."
        )
    raise UsageError(
        f"These recordings went through other stages than those that the model was trained behind: "
        f"{chain_difference(wanted, found)}. Use `tacpipe predict MODEL RECORDINGS -o OUTPUT` with the recordings before "
        f"that stage."
    )


def _command(step: Mapping[str, Any]) -> str:
    """Return the command of a link of a chain, with the params that are not the default."""
    from tacpipe.plugins import params, registry

    usual = params.to_input(params.from_json(registry.load(step["stage"]), {}))
    words = [step["stage"].replace(".", " ")]
    for name, value in params.named(step["stage"], step["params"]).items():
        if usual.get(name) != value:
            option = name.replace("_", "-")
            words.append(f"--{'' if value else 'no-'}{option}" if isinstance(value, bool) else f"--{option} {value}")
    return " ".join(words)
