"""The Python API of tacpipe, a data pipeline for robot touch.

`open` returns a `Dataset`, whose items are `Recording` objects; `run` runs a stage, as a command does; `load` loads a
trained model; `subscribe` receives the messages of a live session; `stage` declares a new stage, which returns a table, a
`RecordingOutput` or a `Result`. Errors are `TacpipeError` and its subclasses.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any, Literal

from tacpipe.errors import (
    DamagedError,
    DeniedError,
    DeviceError,
    LockedError,
    MissingModuleError,
    ResultWarning,
    ShortageError,
    StorageError,
    TacpipeError,
    UsageError,
    WouldChangeError,
)
from tacpipe.plugins.stage import RecordingOutput, Result, Stage, stage

if TYPE_CHECKING:
    from collections.abc import Sequence
    from os import PathLike

    from tacpipe.datasets.dataset import Dataset, Recording
    from tacpipe.live.subscription import Subscription

    __version__: str

__all__ = [
    "DamagedError",
    "Dataset",
    "DeniedError",
    "DeviceError",
    "LockedError",
    "MissingModuleError",
    "Recording",
    "RecordingOutput",
    "Result",
    "ResultWarning",
    "ShortageError",
    "Stage",
    "StorageError",
    "Subscription",
    "TacpipeError",
    "UsageError",
    "WouldChangeError",
    "__version__",
    "load",
    "open",
    "run",
    "stage",
    "subscribe",
]


def __getattr__(name: str) -> Any:
    """Import a name of the API on first access, so that ``import tacpipe`` is fast.

    Raises ``AttributeError`` for others.
    """
    if name in ("Dataset", "Recording"):
        from tacpipe.datasets import dataset

        return getattr(dataset, name)
    if name == "Subscription":
        from tacpipe.live.subscription import Subscription

        return Subscription
    if name == "__version__":
        from importlib.metadata import version

        return version("tacpipe")
    from tacpipe.datasets import guesses

    raise guesses.missing("The module tacpipe", name, guesses.MODULE)


def __dir__() -> list[str]:
    return __all__


def open(path: str | PathLike[str]) -> Dataset:
    """Open the dataset at ``path``, a directory or its manifest.

    Data are read and verified when they are needed:

        dataset = tacpipe.open("data/synced")
        frame = dataset["trial-003"].to_pandas()

    :raises UsageError: if there is no dataset.
    :raises DamagedError: if the manifest was changed.
    """
    from tacpipe.engine.pipeline import open_dataset

    return open_dataset(os.fspath(path))


def run(
    name: str,
    /,
    *datasets: str | PathLike[str] | Dataset,
    output: str | PathLike[str],
    model: str | PathLike[str] | Dataset | None = None,
    split: str | PathLike[str] | Dataset | None = None,
    fold: int = 0,
    role: str | None = None,
    codec: str | PathLike[str] | Dataset | None = None,
    init: str | PathLike[str] | Dataset | None = None,
    extend: str | PathLike[str] | Dataset | None = None,
    preset: str | None = None,
    params_file: str | PathLike[str] | None = None,
    block: str | None = None,
    jobs: int = 0,
    executor: str = "",
    device: Literal["auto", "cpu", "cuda", "mps"] = "auto",
    skip_bad: bool = False,
    rerun: bool = False,
    replace: bool = False,
    progress: bool = False,
    track: Sequence[str] = (),
    **params: Any,
) -> Dataset | Any:
    """Run a stage and return its opened output, from the store if the result exists.

    It is the command ``tacpipe NAME DATASETS... -o OUTPUT`` with the same key, so both reuse each other's results:

        synced = tacpipe.run("synchronize", "data/recordings", output="data/synced", rate_hz=25)
        model = tacpipe.run("train.forward", "data/segments", split="data/split", output="models/forward", epochs=2)

    :param name: the stage, built in or of a plug-in; ``GROUP.METHOD`` for two words, as ``"segment.contacts"``.
    :param datasets: datasets to read, paths or opened ones; for ``ingest`` the folder of the recordings.
    :param output: the directory to write; a file such as ``"report.html"`` for a stage that writes one file.
    :param model: the trained model of ``evaluate`` and ``predict``.
    :param split: the split that assigns roles to recordings, with ``fold``; ``role`` selects the role to read.
    :param codec: a dataset whose fitted codec to apply; ``init``: a model to begin with; ``extend``: an older split
        whose roles to keep.
    :param preset: a preset of params. ``params_file`` names a file of params, and ``block`` its block.
    :param jobs: number of processes; 0: one per core. ``skip_bad`` skips recordings that cannot be read, ``rerun``
        computes even if a result is stored, and ``replace`` replaces other content of the output.
    :param device: device to train on: cpu, cuda or mps; auto is cuda if there is one.
    :param progress: whether to show progress and print the output of the command.
    :param track: trackers of a training, as ``("tensorboard", "mlflow:http://127.0.0.1:5000")``.
    :param params: params of the stage, checked as on the command line.
    :returns: a `Dataset`, or a `pathlib.Path` if the output is a file.
    :raises UsageError: for an unknown stage, param or value, a missing input, or an output that must not be replaced.
    :raises TacpipeError: if the stage cannot read its inputs. A stage may raise other errors.

    A note of the command becomes a `ResultWarning`.
    """
    from tacpipe.engine import calling

    named_inputs = {"model": model, "split": split, "codec": codec, "init": init, "extend": extend}
    return calling.call(
        name.replace(" ", "."),
        datasets,
        output,
        {key: source for key, source in named_inputs.items() if source is not None},
        params,
        calling.How(
            fold=fold,
            role=role,
            preset=preset,
            params_file=params_file,
            block=block,
            jobs=jobs,
            executor=executor,
            device=device,
            skip_bad=skip_bad,
            rerun=rerun,
            replace=replace,
            progress=progress,
            track=track,
        ),
    )


def load(path: str | PathLike[str]) -> Any:
    """Load the model at ``path``, the output of `tacpipe train`.

    ``model.predict`` takes a dataset or one of its recordings. It first runs the model's preprocessing stages that the
    recordings lack, and returns the arrow table that ``tacpipe predict`` writes:

        model = tacpipe.load("models/forward")
        table = model.predict(tacpipe.open("data/segments"))

    ``predict`` also takes arrays, as the class of the model describes: `ForwardModel`, `MaterialModel` or `TouchModel`.

    :raises UsageError: if ``path`` is not a model.
    """
    from tacpipe.plugins import extras
    from tacpipe.tasks.task import task_of_model

    model = open(path)
    with extras.explain_missing("A model"):
        from tacpipe.tasks.recordings import OpenedChain

        return task_of_model(model.files, str(path)).load(model.files, OpenedChain(model))


def subscribe(address: str, max_age_ms: float = 100.0) -> Subscription:
    """Receive the messages of the live session at ``address``, each at most ``max_age_ms`` old, or unknown.

        with tacpipe.subscribe("ws://127.0.0.1:8765", max_age_ms=100) as messages:
            for message in messages:
                alarm = message.get("alarm", "unknown")

    The age counts from the measurement of the newest sample. Each step returns the newest message, and never waits longer
    than ``max_age_ms``: without a message, or a session, it returns ``{"kind": "unknown", "cause": ...}``.

    :param address: ``ws://HOST:PORT``, as in ``tacpipe live --publish ws:HOST:PORT``; with ``/?token=TOKEN`` if the session
        has a token.
    :param max_age_ms: maximum age and waiting time in ms, at least two periods of the session.
    :raises UsageError: for another address, or an age that is not above 0.
    :raises MissingModuleError: without the extra ``live``.
    """
    from tacpipe.live.subscription import Subscription

    return Subscription(address, max_age_ms)
