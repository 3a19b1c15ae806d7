"""Recordings brought to where a model reads them: through the stages that it was trained behind, outside of a command."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from tacpipe.datasets.dataset import Dataset
from tacpipe.engine import execution
from tacpipe.engine.by_recording import ByRecording
from tacpipe.engine.executors.executor import Chosen
from tacpipe.engine.outcome import Outcome
from tacpipe.engine.request import Request
from tacpipe.io.hashing import bytes_digest
from tacpipe.store.location import locate


def continued(recordings: Dataset, model: Dataset) -> Dataset:
    """Run the remaining stages of a model's chain on recordings and return the result.

    Stored results are reused, and new ones are stored, as with ``tacpipe predict``. Both datasets
    must be open. Raises `UsageError` where the recordings went through other stages, `TacpipeError` where one of them
    cannot be read.
    """
    assert recordings.path is not None and model.path is not None
    source = recordings.source
    selected = replace(source, recordings={name: source.recordings[name] for name in recordings.recordings})
    dataset_dirs = (str(recordings.path), str(model.path))
    store = locate(recordings.path, model.path)
    manifests = [source.content_digest, bytes_digest(model.source.content)]
    with Chosen("", 0) as chosen, store.at_work(manifests):
        mapping = ByRecording(store, Request("", None, Path()), Outcome(Path()), chosen)
        replayed = mapping.replay(selected, model.source, dataset_dirs, str(recordings.path))
    return Dataset(replayed, execution.reader(store, dataset_dirs))
