"""The trackers of a command: what ``--track`` names, each started with the first epoch and failing alone."""

from __future__ import annotations

import contextlib
import functools
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tacpipe.datasets.manifest import Manifest
from tacpipe.errors import TacpipeError
from tacpipe.io import progress
from tacpipe.metrics import headline
from tacpipe.plugins import extras, registry
from tacpipe.store.store import Store
from tacpipe.trackers import tracker
from tacpipe.trackers.tracker import Scalar, Tracker
from tacpipe.training.schedule import learning_rate

CONFIG, HISTORY = "config.json", "history.jsonl"
LEARNING_RATE = "learning_rate"
_DIGITS = 8  # digits of a key that make a run's name unique
Line = Mapping[str, Any]


def open_trackers(options: Sequence[str]) -> dict[str, Tracker]:
    """Return the trackers that ``--track`` names, as ``mlflow`` or ``mlflow:http://127.0.0.1:5000``.

    Raises `UsageError` for a name that there is not, and `MissingModuleError` for one whose extra is not installed.
    """
    trackers = {}
    for text in options:
        name, _, place = text.partition(":")
        with extras.explain_missing(f"The tracker {name}"):
            trackers[text] = registry.load_tracker(name)(place)
    return trackers


def name_of(output: Path, key: str) -> str:
    """Return the name of a run: the output as seen from the working directory, and the start of the result's key."""
    path = output.absolute()
    relative = path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else Path(path.name)
    return f"{relative.as_posix()}-{key[:_DIGITS]}"


def files(manifest: Manifest, store: Store) -> dict[str, bytes]:
    """Return those files of a dataset that a run is given figures and epochs from."""
    names = (CONFIG, HISTORY, headline.FILE, headline.SUMMARY)
    return {name: store.read(manifest.files[name]["digest"]) for name in names if name in manifest.files}


@dataclass
class Tracking:
    """Several trackers as one, which follows trainings; what one of them raises ends it alone."""

    trackers: dict[str, Tracker]  # keyed by the option ``--track``
    name: str  # params of the run
    params: Mapping[str, Scalar]
    failures: list[str] = field(default_factory=list)
    _started: bool = False
    _lines: int = 0
    _labels: Mapping[str, Any] = field(default_factory=dict)
    _labelled: bool = False

    # ---- as a follower of trainings

    def begin(self, network: Any, history: Sequence[Line]) -> None:
        """Start the run with the first network, and add the epochs before an interruption."""
        self.start()
        self._labels, self._labelled = network.labels, network.count > 1
        for line in history:
            self._add({**line, **self._labels}, {})

    def batch(self, passed: float, loss: Callable[[], float]) -> None:
        """Nothing: trackers have epochs."""

    def line(self, line: Line, rate: float) -> None:
        """Add an epoch."""
        self._add({**line, **self._labels}, {LEARNING_RATE: rate})

    def end(self, *, trained: bool) -> None:
        """Nothing: the run ends once its model is published."""

    # ---- as the command's

    def start(self) -> None:
        """Start the run, if it has not begun, and report where each tracker shows it."""
        if not self._started:
            self._started = True
            for option, tracker_client in list(self.trackers.items()):
                place = self._call(option, functools.partial(tracker_client.start, self.name, self.params))
                if place is not None:
                    progress.report(f"tracked by {option.partition(':')[0]}: {place}")

    def finish(self, path: Path, files: Mapping[str, bytes]) -> None:
        """End the run of a dataset at ``path``, some of whose files are given.

        Epochs of its history that were not added as it was trained are: all of a stored model, and those whose messages
        did not come from another computer.
        """
        config = _tree(files.get(CONFIG, b"{}"))
        if not self._started:  # nothing was trained: a stored model, or a result, whose params are its model's
            self.params = {**tracker.params(config.get("params", {})), **self.params}
        self.start()
        self.replay(files.get(HISTORY, b""), config.get("params", {}))
        values = tracker.figures(config.get("validation") or {}, "best/")
        if headline.FILE in files:  # a result: those of an older version have no summary
            stored = _tree(files.get(headline.SUMMARY, b"{}"))
            values = tracker.figures(stored or headline.summarize(headline.read(files[headline.FILE])))
        for option, tracker_client in list(self.trackers.items()):
            self._call(option, functools.partial(tracker_client.end, path, values))

    def replay(self, history: bytes, model_params: Mapping[str, Any]) -> None:
        """Add the epochs of a stored history that were not added yet; ``model_params`` state the learning rate."""
        lines = [json.loads(line) for line in history.splitlines() if line.strip()]
        self._labelled = tracker.has_several_networks(lines)
        for line in lines[self._lines :]:
            self._add(line, _rate(model_params, line["epoch"]))

    def abandon(self) -> None:
        """End a run whose result was not made."""
        if self._started:
            for option, tracker_client in list(self.trackers.items()):
                self._call(option, functools.partial(tracker_client.end, None, {}))

    def _add(self, line: Line, additions: Mapping[str, float]) -> None:
        self._lines += 1
        values = tracker.metrics({**line, **additions}, labelled=self._labelled)
        for option, tracker_client in list(self.trackers.items()):
            self._call(option, functools.partial(tracker_client.line, int(line["epoch"]), values))

    def _call(self, option: str, call: Callable[[], Any]) -> Any:
        """Return what the call returns; None where it fails, which ends the tracker. Standard output is the command's."""
        try:
            with contextlib.redirect_stdout(sys.stderr):
                return call()
        except (Exception, SystemExit) as error:  # whatever a third party's client raises
            del self.trackers[option]
            text = str(error) if isinstance(error, TacpipeError) else f"{type(error).__name__}: {error}"
            first = text.strip().splitlines()[0] if text.strip() else type(error).__name__
            sentence = f"the tracker {option} failed and is left out ({first[:300]})"
            progress.report(f"{sentence}; the command continues.")
            self.failures.append(f"{sentence}.")
            return None


def _rate(model_params: Mapping[str, Any], epoch: int) -> dict[str, float]:
    """Return the learning rate of an epoch of a stored model; nothing where its params do not state it."""
    peak, epochs = model_params.get("learning_rate"), model_params.get("epochs")
    if not isinstance(peak, int | float) or not isinstance(epochs, int) or epochs < 1:
        return {}
    return {LEARNING_RATE: learning_rate(peak, (epoch - 1) / epochs, cycle=bool(model_params.get("cycle")))}


def _tree(content: bytes) -> dict[str, Any]:
    value = json.loads(content)
    return value if isinstance(value, dict) else {}
