"""Recordings that a model is to predict: opened datasets, behind the stages that the model was trained behind."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tacpipe.datasets.dataset import Dataset, Recording
from tacpipe.datasets.selection import chain_difference
from tacpipe.errors import UsageError


@dataclass(frozen=True)
class OpenedChain:
    """The stages that a model was trained behind, and what they fitted: those of the opened ``model``."""

    model: Dataset

    @property
    def steps(self) -> Sequence[Mapping[str, Any]]:
        """The stages one by one, as manifests name them."""
        return self.model.source.chain


def opened(recordings: Dataset | Recording, chain: OpenedChain | None) -> Dataset:
    """Return a dataset, or the one of a recording alone, after the stages of ``chain``; None: as it is.

    Those stages that it has not been through yet are run, as ``tacpipe predict`` does. Raises `UsageError` for anything
    else than a dataset or a recording, and where it went through other stages.
    """
    if isinstance(recordings, Recording):
        recordings = recordings.alone
    if not isinstance(recordings, Dataset):
        raise UsageError(
            f"A {type(recordings).__name__} is not a dataset or a recording. Give tacpipe.open(PATH), or one of its "
            f"recordings: tacpipe.open(PATH)['trial-000']."
        )
    if chain is None or list(recordings.source.chain) == list(chain.steps):
        return recordings
    _check(chain.steps, recordings)
    from tacpipe.engine import by_recording

    return by_recording.run_chain_of_model(recordings, chain.model)


def _check(expected: Sequence[Mapping[str, Any]], recordings: Dataset) -> None:
    chain = recordings.source.chain
    if list(chain) != list(expected[: len(chain)]):
        raise UsageError(
            f"These recordings went through other stages than those that the model was trained behind: "
            f"{chain_difference(expected, chain)}. Give the recordings before that stage."
        )
    if recordings.path is None:
        missing = ", then ".join(f"`tacpipe {_command(step)}`" for step in expected[len(chain) :])
        raise UsageError(
            f"These recordings did not go through all stages that the model was trained behind: {missing} is missing. "
            f"Run it, or give what tacpipe.open returned."
        )


def _command(step: Mapping[str, Any]) -> str:
    """Return the command of a link of a chain, with the params that are not the default."""
    from tacpipe.plugins import params, registry

    usual = params.to_input(params.from_json(registry.load(step["stage"]), {}))
    words = [step["stage"].replace(".", " ")]
    for name, value in params.with_current_names(step["stage"], step["params"]).items():
        if usual.get(name) != value:
            option = name.replace("_", "-")
            words.append(f"--{'' if value else 'no-'}{option}" if isinstance(value, bool) else f"--{option} {value}")
    return " ".join(words)
