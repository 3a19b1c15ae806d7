"""Send params, epochs and figures to experiment trackers, during training or from stored results."""

from __future__ import annotations

import contextlib
import functools
import json
import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from tacpipe.datasets import manifest
from tacpipe.datasets.lineage import identities_of_manifests
from tacpipe.datasets.manifest import Manifest
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io import Json, Scalar, terminal
from tacpipe.io.credentials import refuse_credentials, without_credentials
from tacpipe.io.hashing import digest
from tacpipe.plugins import extras, registry
from tacpipe.scores import headline
from tacpipe.store.location import locate
from tacpipe.store.store import Store
from tacpipe.training.following import Line, NetworkLabels, TrainedNetwork, read_history
from tacpipe.training.schedule import learning_rate


class Tracker(Protocol):
    """A run of one tracker, created with the part after the colon of ``--track NAME:PLACE``, or "" for its default.

    An exception of any method is reported once, and the tracker is not called again; it never ends a training.
    """

    def start(self, name: str, params: Mapping[str, Scalar]) -> str:
        """Start or resume the run ``name``, which is unique to a result; return where it can be viewed.

        A resumed run receives all its epochs again.
        """

    def line(self, epoch: int, metrics: Mapping[str, float]) -> None:
        """Add the metrics of an epoch, counted from 1: losses, learning rate, and other validation metrics."""

    def end(self, path: Path | None, figures: Mapping[str, float]) -> None:
        """End the run. ``path`` is that of the model or results with these figures, or None without them."""


def flat_params(nested: Json) -> dict[str, Scalar]:
    """Return params by dotted name, with lists as text.

    >>> flat_params({"epochs": 2, "sweep": {"kind": "pca", "widths": [2, 4]}, "init": None})
    {'epochs': 2, 'sweep.kind': 'pca', 'sweep.widths': '2, 4', 'init': 'none'}
    """
    return dict(_leaves(nested, "."))


def flat_figures(nested: Json, under: str = "") -> dict[str, float]:
    """Return the finite numbers in nested values by their path.

    >>> flat_figures({"val_loss": 0.5, "best": True, "val": {"biotac": {"accuracy": 0.25}}, "note": "x"}, "a/")
    {'a/val_loss': 0.5, 'a/val/biotac/accuracy': 0.25}
    """
    return {f"{under}{name}": float(value) for name, value in _leaves(nested, "/") if _is_number(value)}


def flat_metrics(line: Line, learning_rate: float | None = None, *, labelled: bool) -> dict[str, float]:
    """Return the metrics in a history line, prefixed by its labels if ``labelled``, for several networks.

    >>> flat_metrics({"epoch": 3, "val_loss": 0.5, "target": "pdc_th", "network": 1}, labelled=True)
    {'pdc_th/1/val_loss': 0.5}
    """
    labels = _labels(line) if labelled else ()
    metrics = {name: value for name, value in line.items() if name not in ("epoch", "target", "network")}
    rate = {} if learning_rate is None else {LEARNING_RATE: learning_rate}
    return flat_figures({**metrics, **rate}, "".join(f"{label}/" for label in labels if label is not None))


def has_several_networks(lines: Iterable[Line]) -> bool:
    """Return whether a history contains lines of several networks."""
    return len({_labels(line) for line in lines}) > 1


def _labels(line: Line) -> tuple[str | None, int | None]:
    return line.get("target"), line.get("network")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _leaves(value: Json, between: str, name: str = "") -> Iterable[tuple[str, Scalar]]:
    """Yield the path, joined with ``between``, and the scalar of each entry in nested values; lists are joined as text."""
    for key, entry in value.items():
        path = f"{name}{between}{key}" if name else str(key)
        if isinstance(entry, Mapping):
            yield from _leaves(entry, between, path)
        elif isinstance(entry, Sequence) and not isinstance(entry, str):
            yield path, ", ".join(map(str, entry))
        else:
            yield path, "none" if entry is None else entry


CONFIG, HISTORY = "config.json", "history.jsonl"
LEARNING_RATE = "learning_rate"
_DIGITS = 8  # number of digits of a key that make a run's name unique


def open_trackers(options: Sequence[str]) -> dict[str, Tracker]:
    """Return the trackers in ``--track`` options such as ``mlflow`` or ``mlflow:http://127.0.0.1:5000``.

    Raises `UsageError` for an unknown tracker or a place with credentials, and `MissingModuleError` if its extra is not
    installed.
    """
    trackers = {}
    for text in options:
        refuse_credentials(text, "--track")
        name, _, place = text.partition(":")
        with extras.explain_missing(f"The tracker {name}"):
            trackers[text] = registry.load_tracker(name)(place)
    return trackers


def name_of(output: Path, key: str) -> str:
    """Return the name of a run: the output's path relative to the working directory, and the start of the result's key."""
    path = output.absolute()
    relative = path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else Path(path.name)
    return f"{relative.as_posix()}-{key[:_DIGITS]}"


def files(manifest: Manifest, store: Store) -> dict[str, bytes]:
    """Return the files of a dataset with figures and epochs for a run."""
    names = (CONFIG, HISTORY, headline.FILE, headline.SUMMARY)
    return {name: store.read(manifest.files[name]["digest"]) for name in names if name in manifest.files}


@dataclass
class Tracking:
    """Several trackers that follow trainings as one; an exception of a tracker only ends that tracker."""

    trackers: dict[str, Tracker]  # trackers by their option ``--track``
    name: str  # name of the run
    params: Mapping[str, Scalar]
    failures: list[str] = field(default_factory=list)
    _started: bool = False
    _lines: int = 0
    _labels: NetworkLabels = field(default_factory=NetworkLabels)
    _labelled: bool = False

    # ---- as a follower of trainings

    def begin(self, network: TrainedNetwork, history: Sequence[Line]) -> None:
        """Start the run with the first network, and add the epochs from before an interruption."""
        self.start()
        self._labels, self._labelled = network.labels, network.count > 1
        for line in history:
            self._add({**line, **self._labels}, None)

    def batch(self, passed: float, loss: Callable[[], float]) -> None:
        """Do nothing, because trackers record epochs."""

    def line(self, line: Line, rate: float) -> None:
        """Add an epoch."""
        self._add({**line, **self._labels}, rate)

    def end(self, *, trained: bool) -> None:
        """Do nothing, because the run ends when its model is published."""

    # ---- as the command's

    def start(self) -> None:
        """Start the run if it has not started, and report where each tracker shows it."""
        if not self._started:
            self._started = True
            for option, tracker_client in list(self.trackers.items()):
                place = self._call(option, functools.partial(tracker_client.start, self.name, self.params))
                if place is not None:
                    terminal.report_progress(f"tracked by {option.partition(':')[0]}: {place}")

    def finish(self, path: Path, files: Mapping[str, bytes]) -> None:
        """End the run of a dataset at ``path``, given some of its files.

        Epochs that were not added during training are added now: all epochs of a stored model, and those whose messages
        did not arrive from another computer.
        """
        config = _tree(files.get(CONFIG, b"{}"))
        model_params = flat_params(config.get("params", {}))
        if not self._started:  # nothing was trained: a stored model, or a result, which has the params of its model
            self.params = {**model_params, **self.params}
        self.start()
        self.replay(files.get(HISTORY, b""), model_params)
        values = flat_figures(config.get("validation") or {}, "best/")
        if headline.FILE in files:  # a result; older versions have no summary
            stored = _tree(files.get(headline.SUMMARY, b"{}"))
            values = flat_figures(stored or headline.summarize(headline.read(files[headline.FILE])))
        for option, tracker_client in list(self.trackers.items()):
            self._call(option, functools.partial(tracker_client.end, path, values))

    def replay(self, history: bytes, model_params: Mapping[str, Scalar]) -> None:
        """Add the missing epochs of a stored history; ``model_params`` contain the learning rate."""
        lines = read_history(history)
        self._labelled = has_several_networks(lines)
        for line in lines[self._lines :]:
            self._add(line, _rate(model_params, line["epoch"]))

    def abandon(self) -> None:
        """End a run without a result."""
        if self._started:
            for option, tracker_client in list(self.trackers.items()):
                self._call(option, functools.partial(tracker_client.end, None, {}))

    def _add(self, line: Line, rate: float | None) -> None:
        self._lines += 1
        values = flat_metrics(line, rate, labelled=self._labelled)
        for option, tracker_client in list(self.trackers.items()):
            self._call(option, functools.partial(tracker_client.line, int(line["epoch"]), values))

    def _call(self, option: str, call: Callable[[], Any]) -> Any:
        """Return the result of the call, or None if it fails, which ends the tracker.

        Keeps standard output for the command.
        """
        try:
            with contextlib.redirect_stdout(sys.stderr):
                return call()
        except (Exception, SystemExit) as error:  # third-party clients may raise anything
            del self.trackers[option]
            text = str(error) if isinstance(error, TacpipeError) else f"{type(error).__name__}: {error}"
            first = without_credentials(text.strip().splitlines()[0]) if text.strip() else type(error).__name__
            sentence = f"the tracker {option} failed and is left out ({first[:300]})"
            terminal.report_progress(f"{sentence}; the command continues.")
            self.failures.append(f"{sentence}.")
            return None


def _rate(model_params: Mapping[str, Scalar], epoch: int) -> float | None:
    """Return the learning rate of an epoch of a stored model, or None if its params do not determine it."""
    peak, epochs = model_params.get("learning_rate"), model_params.get("epochs")
    if not isinstance(peak, int | float) or not isinstance(epochs, int) or epochs < 1:
        return None
    return learning_rate(peak, (epoch - 1) / epochs, cycle=bool(model_params.get("cycle")))


def _tree(content: bytes) -> Json:
    value = json.loads(content)
    return value if isinstance(value, dict) else {}


def track_stored(paths: Sequence[Path], trackers: Sequence[str]) -> list[str]:
    """Send each dataset's params, epochs and figures to ``trackers``; return the names of the runs.

    A run has the same name as with ``--track``, so a result that was tracked during training is the same run. Raises
    `UsageError` for a dataset without epochs and figures, and for an unknown tracker.
    """
    stored = [manifest.find(path) for path in paths]
    for path, entry in zip(paths, stored, strict=True):
        if not {CONFIG, HISTORY} & set(entry.manifest.files):
            raise UsageError(f"{path} was made by {entry.manifest.stage}; give a model or a result.")
    names, identities_of = [], functools.cache(identities_of_manifests)
    for path, entry in zip(paths, stored, strict=True):
        store = locate(entry.directory)
        identity, run_manifest = identities_of(store).get(entry.digest), entry.manifest
        fold = 0 if identity is None else identity.get("fold", 0)
        params = {**run_manifest.params, "stage": run_manifest.stage, "fold": fold}
        name = name_of(path, entry.digest if identity is None else digest(identity))
        Tracking(open_trackers(trackers), name, flat_params(params)).finish(path, files(run_manifest, store))
        names.append(name)
    return names
