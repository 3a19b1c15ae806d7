"""Open recordings for prediction by a model, and record the digests of its training recordings.

Opened datasets pass through the model's preprocessing stages. ``trained_on`` of a configuration maps recording names to
digests: evaluation reports these recordings separately, and calibration rejects them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from tacpipe.datasets.dataset import Dataset, Recording
from tacpipe.datasets.selection import chain_difference
from tacpipe.engine import by_recording
from tacpipe.errors import UsageError
from tacpipe.plugins import params, registry
from tacpipe.store.records import Step


@dataclass(frozen=True)
class OpenedChain:
    """The preprocessing stages of the opened ``model``, with their fitted parts."""

    model: Dataset

    @property
    def steps(self) -> Sequence[Step]:
        """The single stages, as listed in manifests."""
        return self.model.source.chain


def open_for_model(recordings: Dataset | Recording, chain: OpenedChain | None) -> Dataset:
    """Return a dataset, or a dataset of one recording, after the stages of ``chain``; unchanged if that is None.

    Missing stages are run, as by ``tacpipe predict``. Raises `UsageError` for anything other than a dataset or a
    recording, and if it passed through other stages.
    """
    dataset = recordings.alone if isinstance(recordings, Recording) else recordings
    if not isinstance(dataset, Dataset):
        raise UsageError(
            f"A {type(recordings).__name__} is not a dataset or a recording. Give tacpipe.open(PATH), or one of its "
            f"recordings: tacpipe.open(PATH)['trial-000']."
        )
    if chain is None or list(dataset.source.chain) == list(chain.steps):
        return dataset
    _check_stages(chain.steps, dataset)

    return by_recording.run_chain_of_model(dataset, chain.model)


def _check_stages(expected: Sequence[Step], recordings: Dataset) -> None:
    """Raise `UsageError` unless the recordings went through the first of the ``expected`` stages and no others."""
    chain = recordings.source.chain
    if list(chain) != list(expected[: len(chain)]):
        raise UsageError(
            f"These recordings went through other stages than the recordings that the model was trained on: "
            f"{chain_difference(expected, chain)}. Give the recordings before that stage."
        )
    if recordings.path is None:
        missing = ", then ".join(f"`tacpipe {_command(step)}`" for step in expected[len(chain) :])
        raise UsageError(
            f"These recordings did not go through all stages of the recordings that the model was trained on: {missing} is "
            f"missing. Run it, or give what tacpipe.open returned."
        )


def _command(step: Step) -> str:
    """Return the command of a step of a chain, with the params that differ from their defaults."""
    default_values = params.to_input(params.from_json(registry.load(step["stage"]), {}))
    words = [step["stage"].replace(".", " ")]
    for name, value in params.with_current_names(step["stage"], step["params"]).items():
        if default_values.get(name) != value:
            option = name.replace("_", "-")
            switch = f"--{option}" if value else f"--no-{option}"
            words.append(switch if isinstance(value, bool) else f"--{option} {value}")
    return " ".join(words)


def merge_trained_on(*parts: Iterable[tuple[str, str]]) -> dict[str, str]:
    """Return the digests of recordings by name, from parts with pairs of name and digest."""
    return {name: digest for part in parts for name, digest in part}


def trained_on_datasets(*parts: Dataset) -> dict[str, str]:
    """Return the digests of the recordings of several datasets by name."""
    return merge_trained_on(*(((shard.name, shard.digest) for shard in part.recordings.values()) for part in parts))


def add_earlier(digests: Mapping[str, str], earlier: Mapping[str, str]) -> dict[str, str]:
    """Return a training's digests by name, and those of the initial model under marked names.

    >>> add_earlier({"a": "1"}, {"a": "1", "b": "2"})
    {'b of the model before': '2', 'a': '1'}
    """
    current = set(digests.values())
    marked = {f"{name} of the model before": digest for name, digest in earlier.items() if digest not in current}
    return {**marked, **digests}


def add_calibration(digests: Mapping[str, str], calibration: Mapping[str, str]) -> dict[str, str]:
    """Return a training's digests by name, and those of the calibration recordings.

    A calibration recording gets a marked name if the training has another recording of the same name.

    >>> add_calibration({"a": "1"}, {"a": "2", "b": "3", "c": "1"})
    {'a': '1', 'a of calibration': '2', 'b': '3'}
    """
    current = set(digests.values())
    further = {name: digest for name, digest in calibration.items() if digest not in current}
    return {
        **digests,
        **{f"{name} of calibration" if name in digests else name: digest for name, digest in further.items()},
    }
