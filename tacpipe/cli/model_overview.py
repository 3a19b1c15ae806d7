"""Describe models and results from their JSON files and the headers of their weights, without heavy imports."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

from tacpipe.cli import headline_table
from tacpipe.cli.description import SHOWN, align, flat
from tacpipe.datasets.dataset import Dataset
from tacpipe.datasets.lineage import identities_of_manifests
from tacpipe.datasets.manifest import Found, InputDataset
from tacpipe.errors import TacpipeError
from tacpipe.io import Scalar, terminal
from tacpipe.plugins import params as params_of
from tacpipe.plugins.stage import StoredParams, Values
from tacpipe.printable import format_count
from tacpipe.scores import headline
from tacpipe.store.store import Store
from tacpipe.training.following import Line

CONFIG, METRICS, HISTORY = "config.json", "metrics.json", "history.jsonl"
WEIGHTS = ".safetensors"
_APART = ("task", "architecture", "params", "counts", "validation", "trained_on", "parameters", "seconds")
_ROLES = ("train", "val", "test")


def is_model(opened: Dataset) -> bool:
    """Return whether a dataset is a model, i.e. has a configuration with a task, and no metrics."""
    return CONFIG in opened.files and METRICS not in opened.files and "task" in _read_tree(opened, CONFIG)


def is_result(opened: Dataset) -> bool:
    """Return whether a dataset is an evaluation result."""
    return METRICS in opened.files


Figures = Mapping[str, Scalar | Mapping[str, Scalar]]  # counts or measures by name, or by role and sensor


class TrainingCounts(TypedDict):
    """Numbers of recordings that a model was trained on."""

    recordings: int | None  # number of recordings for training and validation
    roles: Figures  # number of recordings by role, or by role and sensor


class TrainingOverview(TypedDict):
    """Entries for models and for their results: the task, and how the model was trained."""

    task: str | None
    architecture: str | None  # its current name
    trained_on: TrainingCounts
    params: StoredParams
    inputs: dict[str, list[str]]  # paths and digests by argument name


class BestEpoch(TypedDict):
    """Epoch with the lowest validation loss."""

    epoch: int
    loss: float


class ModelOverview(TrainingOverview):
    """Overview of a model: its size, validation, and the short entries of its configuration."""

    about: dict[str, str]  # other entries as text
    parameters: int | None
    epochs: int | None
    validation: Figures | BestEpoch | None
    chain: list[str]


class ResultOverview(TrainingOverview):
    """Overview of a result: the model and its baselines, the evaluated data and their role."""

    headline: list[Values] | None
    baselines: list[str]
    evaluated_on: Figures
    by_part: dict[str, Figures]
    fold: int | None
    role: str | None


def of_model(opened: Dataset, store: Store) -> ModelOverview:
    """Return the overview of a model: task, architecture, training data, params and validation.

    Raises the errors of `_read_tree`.
    """
    config, history = _read_tree(opened, CONFIG), _history(opened)
    about = {name.replace("_", " "): _short_text(entry) for name, entry in config.items() if name not in _APART}
    return {
        **_describe_training(opened, {"params": opened.source.params, **config}, store),
        "about": {name: text for name, text in about.items() if text is not None},
        "parameters": config.get("parameters") or _count_parameters(opened),
        "epochs": len(history) or None,
        "validation": config.get("validation") or _best(history),
        "chain": [f"{step['stage']} {step['version']}" for step in opened.source.chain],
    }


def of_result(opened: Dataset, found: Found, store: Store) -> ResultOverview:
    """Return the overview of a result: the model and its baselines, the evaluated data and their role.

    ``found`` is its manifest in ``store``. Raises the errors of `_read_tree`.
    """
    metrics = _read_tree(opened, METRICS)
    headlines = headline_table.read(opened.files[headline.FILE]) if headline.FILE in opened.files else None
    identity = identities_of_manifests(store).get(found.digest)
    return {
        **_describe_training(opened, _read_tree(opened, CONFIG), store),
        "headline": None if headlines is None else [entry.to_json() for entry in headlines],
        "baselines": list(dict.fromkeys(row.name for entry in headlines or () for row in entry.baselines)),
        "evaluated_on": metrics.get("counts", {}),
        "by_part": {
            name: part["counts"] for name, part in metrics.items() if isinstance(part, dict) and "counts" in part
        },
        "fold": None if identity is None else identity.get("fold"),
        "role": ((identity and identity.get("role")) or "test") if "split" in opened.source.inputs else None,
    }


def _describe_training(opened: Dataset, config: Values, store: Store) -> TrainingOverview:
    """Return the entries of the configuration of a model, or of the model of a result, and the inputs of the dataset."""
    task, architecture, trained = config.get("task"), config.get("architecture"), config.get("trained_on")
    return {
        "task": task,
        "architecture": None if architecture is None else headline_table.method(task, architecture),
        "trained_on": {
            # training and validation recordings
            "recordings": len(trained) if isinstance(trained, Mapping) else None,
            "roles": {role: count for role, count in config.get("counts", {}).items() if role in _ROLES},
        },
        "params": params_of.with_current_names(f"train.{task}", config.get("params", {})),
        "inputs": _inputs(opened.source.inputs, store),
    }


def to_text(value: Mapping[str, Any]) -> list[str]:
    """Return the overview of a model or a result as lines: its summary or its headlines, then its other entries by name."""
    if "headline" not in value:
        lines = [_summary(value)]
    elif value["headline"] is None:
        lines = ["This result was evaluated before headlines were kept: run `tacpipe evaluate` again to have them."]
    else:
        headlines = [headline.Headline.from_json(entry) for entry in value["headline"]]
        lines = headline_table.text(headlines, terminal.width_of(sys.stdout)).splitlines()
    fold = f", fold {value['fold']}" if value.get("fold") is not None else ""
    described = [
        ("task", value["task"]),
        ("architecture", value["architecture"]),
        ("parameters", f"{value['parameters']:,}" if value.get("parameters") else None),
        ("evaluated on", flat(value["evaluated_on"]) if "evaluated_on" in value else None),
        *((f"  {name}", flat(counts)) for name, counts in value.get("by_part", {}).items()),
        ("role", f"{value['role']}{fold}" if value.get("role") else None),
        ("baselines", ", ".join(value.get("baselines", []))),
        ("trained on", _count_training(value["trained_on"])),
        ("epochs", value.get("epochs")),
        ("validation", flat(value["validation"]) if value.get("validation") else None),
        *value.get("about", {}).items(),
        ("params", flat(value["params"]) if value["params"] else None),
        ("behind", ", then ".join(value.get("chain", []))),
        *value["inputs"].items(),
    ]
    return [*lines, "", *align(described)]


def _summary(value: Mapping[str, Any]) -> str:
    """Return architecture, task, number of epochs and validation result on one line, without those that are missing."""
    parts = [f"{value['architecture'] or 'a model'} for {value['task']}"]
    if value["epochs"]:
        parts.append(format_count(value["epochs"], "epochs"))
    if value["validation"]:
        parts.append(f"validation: {flat(value['validation'])}")
    return "; ".join(parts)


def _short_text(value: Any) -> str | None:
    """Return a configuration entry as short text, or None if it is empty or long."""
    if isinstance(value, Mapping):
        if all(not isinstance(item, Mapping | list) for item in value.values()) and len(value) <= SHOWN:
            return flat(value) if value else None
        if all(isinstance(item, Mapping) for item in value.values()) and len(value) <= SHOWN:
            return ", ".join(value)
        return None
    if isinstance(value, list):
        if not value or not all(isinstance(item, str | int) for item in value):
            return None
        names = list(dict.fromkeys(map(str, value)))
        return ", ".join(names) if len(names) <= SHOWN else f"{', '.join(names[:SHOWN])} … ({len(names)})"
    return flat(value) if value not in (None, "") else None


def _count_training(trained: TrainingCounts) -> list[str]:
    """Return a line per role with its counts of training data, and a line with the number of recordings."""
    lines = [
        f"{role}: {flat(counts) if isinstance(counts, Mapping) else counts}"
        for role, counts in trained["roles"].items()
    ]
    count = trained["recordings"]
    return [*lines, *([format_count(count, "recordings") + " of training and validation"] if count else [])]


def _inputs(inputs: Mapping[str, Sequence[InputDataset]], store: Store) -> dict[str, list[str]]:
    """Return the datasets of each input as texts with path and digest. Paths come from the store's roots."""
    paths = {root["manifest"]: str(root["path"]) for root in store.roots.all()}
    return {
        name: [f"{paths.get(entry['manifest'], 'in no known location')} [{entry['dataset'][:12]}]" for entry in entries]
        for name, entries in inputs.items()
    }


def _read_tree(opened: Dataset, name: str) -> Values:
    """Return the mapping in a JSON file, or an empty one if it is missing. Raises `TacpipeError` if it is not JSON."""
    if name not in opened.files:
        return {}
    try:
        tree = json.loads(opened.files[name])
    except ValueError:
        raise TacpipeError(f"{name} is not JSON. Run the stage that made it again.") from None
    return tree if isinstance(tree, dict) else {}


def _history(opened: Dataset) -> list[Line]:
    lines = opened.files[HISTORY].splitlines() if HISTORY in opened.files else []
    return [json.loads(line) for line in lines if line.strip()]


def _best(history: list[Line]) -> BestEpoch | None:
    """Return the epoch with the lowest validation loss, or None if the history contains no validation loss."""
    validated = [line for line in history if isinstance(line.get("val_loss"), int | float)]
    best = min(validated, key=lambda line: line["val_loss"], default=None)
    return {"epoch": best["epoch"], "loss": best["val_loss"]} if best else None


def _count_parameters(opened: Dataset) -> int | None:
    """Return the number of weights, from the headers of the model's own safetensors files; None without weights."""
    count = 0
    for name in opened.files:
        if name.endswith(WEIGHTS) and name.startswith("model"):
            content = opened.files[name]
            size = int.from_bytes(content[:8], "little")
            header = json.loads(content[8 : 8 + size])
            count += sum(math.prod(tensor["shape"]) for key, tensor in header.items() if key != "__metadata__")
    return count or None
