"""From a tactile sensor's cable to a table of results that can be traced back to its bytes.

The Python API. `open` gives a `Dataset`, whose items are `Recording` objects; `run` runs a stage, as a command does;
`load` gives a trained model; `stage` declares a stage of one's own, which returns a table, a `RecordingOutput` or a
`Result`. Errors are `TacpipeError` and its subclasses.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any, Literal

from tacpipe.errors import (
    DamagedError,
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

    __version__: str

__all__ = [
    "DamagedError",
    "Dataset",
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
    "TacpipeError",
    "UsageError",
    "WouldChangeError",
    "__version__",
    "load",
    "open",
    "run",
    "stage",
]


def __getattr__(name: str) -> Any:
    """Return what is imported when it is asked for: ``import tacpipe`` stays light."""
    if name in ("Dataset", "Recording"):
        from tacpipe.datasets import dataset

        return getattr(dataset, name)
    if name == "__version__":
        from importlib.metadata import version

        return version("tacpipe")
    raise AttributeError(f"module 'tacpipe' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def open(path: str | PathLike[str]) -> Dataset:
    """Return the dataset whose directory or manifest is ``path``; its bytes are read and verified when asked for.

    Raises `UsageError` if there is no dataset, `DamagedError` if its manifest was changed.
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
    """Run a stage and return its opened output; what was computed before is not computed again.

    It does what the command ``tacpipe NAME DATASETS... -o OUTPUT`` does, with the same key, so that each answers what the
    other computed::

        synced = tacpipe.run("synchronize", "data/recordings", output="data/synced", rate_hz=25)
        model = tacpipe.run("train.forward", "data/segments", split="data/split", output="models/forward", epochs=2)

    :param name: the stage, ``GROUP.METHOD`` where a command has two words: ``"segment.contacts"``, ``"ingest.xela-flat"``;
        a plug-in's as well.
    :param datasets: datasets to read, paths or opened ones; for ``ingest`` the folder of the recordings.
    :param output: the directory to write; the file for a stage that writes one, as ``"report.html"``.
    :param model: the trained model of ``evaluate`` and ``predict``.
    :param split: which recordings train, validate and test, with ``fold``; ``role`` is the one to read.
    :param codec: a dataset whose fitted codec to apply; ``init``: a model to begin with; ``extend``: an older split
        whose roles to keep.
    :param preset: a preset of params. A file of params is read only if ``params_file`` names one (``block``: its block).
    :param jobs: processes to use; 0: one per core. ``skip_bad`` leaves out recordings that cannot be read, ``rerun``
        computes what is stored too, ``replace`` lets the output replace what it must not lose otherwise.
    :param device: what networks are trained on: cpu, cuda or mps; auto is cuda where there is one.
    :param progress: show progress on a terminal, and print what a command prints while it runs.
    :param track: trackers that follow a training, as ``("tensorboard", "mlflow:http://127.0.0.1:5000")``.
    :param params: params of the stage, checked as on the command line.
    :returns: a `Dataset`, or a `pathlib.Path` where the output is a file.
    :raises UsageError: for an unknown stage, param or value, and where an input is missing or the output must stay.
    :raises TacpipeError: where the stage cannot read its inputs; other errors are those of its own code.

    What a command would note about a valid result is a `ResultWarning`.
    """
    from tacpipe.engine import calling

    named_inputs = {"model": model, "split": split, "codec": codec, "init": init, "extend": extend}
    return calling.call(
        name,
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
    """Return the model at ``path``: what its task makes of the files that `tacpipe train` wrote.

    ``model.predict(tacpipe.open(PATH))``, or ``predict`` of one recording of it, returns the arrow table that
    ``tacpipe predict`` writes, after the stages that the model was trained behind: those that the recordings have not been
    through yet are run, and answered by the store where they ran before. ``predict`` also reads arrays; how, the class of
    the model states, which is that of its task. Raises `UsageError` if ``path`` holds no model.
    """
    from tacpipe.datasets import model_files
    from tacpipe.plugins import extras

    model = open(path)
    with extras.explain_missing("A model"):
        from tacpipe.tasks.recordings import OpenedChain

        return model_files.task(model.files, str(path)).load(model.files, OpenedChain(model))
