"""Describe models and results from their JSON files and the headers of their weights, without heavy imports."""

from __future__ import annotations

import json
import math
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypedDict

from tacpipe.cli import headline_table
from tacpipe.datasets.dataset import Dataset
from tacpipe.datasets.lineage import identities_of_manifests
from tacpipe.datasets.manifest import Found, InputDataset
from tacpipe.errors import TacpipeError
from tacpipe.io import Scalar, terminal
from tacpipe.metrics import headline
from tacpipe.plugins import params as params_of
from tacpipe.plugins.stage import StoredParams, Values
from tacpipe.store.store import Store
from tacpipe.training.following import Line

CONFIG, METRICS, HISTORY = "config.json", "metrics.json", "history.jsonl"
WEIGHTS = ".safetensors"
FILES = 5  # maximum number of files of a result that are listed; further files are counted
SHOWN = 8  # maximum length of a displayed list or nested mapping; longer ones are counted
_APART = ("task", "architecture", "params", "counts", "validation", "trained_on", "parameters", "seconds")
_ROLES = ("train", "val", "test")


def is_model(opened: Dataset) -> bool:
    """Return whether a dataset is a model, i.e. has a configuration with a task, and no metrics."""
    return CONFIG in opened.files and METRICS not in opened.files and "task" in _read_tree(opened, CONFIG)


def is_result(opened: Dataset) -> bool:
    """Return whether a dataset is an evaluation result."""
    return METRICS in opened.files


Figures = Mapping[str, Scalar | Mapping[str, Scalar]]  # counts or measures by name, or by role and sensor


class ModelOrigin(TypedDict):
    """Task and current architecture name of a configuration."""

    task: str | None
    architecture: str | None


class TrainingCounts(TypedDict):
    """Numbers of recordings that a model was trained on."""

    recordings: int | None  # number of recordings for training and validation
    roles: Figures  # number of recordings by role, or by role and sensor


class ModelDescription(ModelOrigin):
    """Description of a configuration: task, architecture, training data, and other short entries as text."""

    trained_on: TrainingCounts
    about: dict[str, str]


class BestEpoch(TypedDict):
    """Epoch with the lowest validation loss."""

    epoch: int
    loss: float


class ModelOverview(ModelDescription):
    """Overview of a model: task, architecture, training data, params and validation."""

    parameters: int | None
    epochs: int | None
    validation: Figures | BestEpoch | None
    params: StoredParams
    inputs: dict[str, list[str]]  # paths and digests by argument name
    chain: list[str]


class ResultOverview(ModelOrigin):
    """Overview of a result: the model and its baselines, the evaluated data and their role."""

    headline: list[Values] | None
    baselines: list[str]
    evaluated_on: Figures
    by_part: dict[str, Figures]
    fold: int | None
    role: str | None
    trained_on: TrainingCounts
    params: StoredParams
    inputs: dict[str, list[str]]  # paths and digests by argument name


def of_model(opened: Dataset, store: Store) -> ModelOverview:
    """Return the overview of a model: task, architecture, training data, params and validation.

    Raises the errors of `_read_tree`.
    """
    config, history = _read_tree(opened, CONFIG), _history(opened)
    return {
        **_describe_config(config),
        "parameters": config.get("parameters") or _count_parameters(opened),
        "epochs": len(history) or None,
        "validation": config.get("validation") or _best(history),
        "params": params_of.with_current_names(opened.source.stage, config.get("params", opened.source.params)),
        "inputs": _inputs(opened.source.inputs, store),
        "chain": [f"{step['stage']} {step['version']}" for step in opened.source.chain],
    }


def of_result(opened: Dataset, found: Found, store: Store) -> ResultOverview:
    """Return the overview of a result: the model and its baselines, the evaluated data and their role.

    ``found`` is its manifest in ``store``. Raises the errors of `_read_tree`.
    """
    config, metrics = _read_tree(opened, CONFIG), _read_tree(opened, METRICS)
    headlines = headline_table.read(opened.files[headline.FILE]) if headline.FILE in opened.files else None
    identity = identities_of_manifests(store).get(found.digest)
    return {
        **_architecture(config),
        "headline": None if headlines is None else [entry.to_json() for entry in headlines],
        "baselines": list(dict.fromkeys(row.name for entry in headlines or () for row in entry.baselines)),
        "evaluated_on": metrics.get("counts", {}),
        "by_part": {
            name: part["counts"] for name, part in metrics.items() if isinstance(part, dict) and "counts" in part
        },
        "fold": None if identity is None else identity.get("fold"),
        "role": ((identity and identity.get("role")) or "test") if "split" in opened.source.inputs else None,
        "trained_on": _describe_config(config)["trained_on"],
        "params": params_of.with_current_names(f"train.{config.get('task')}", config.get("params", {})),
        "inputs": _inputs(opened.source.inputs, store),
    }


def model_text(value: ModelOverview) -> list[str]:
    """Return the overview of a model as lines: summary with validation, params, then inputs."""
    described = [
        ("task", value["task"]),
        ("architecture", value["architecture"]),
        ("parameters", f"{value['parameters']:,}" if value["parameters"] else None),
        *_named_once("trained on", _describe_training(value["trained_on"])),
        ("epochs", value["epochs"]),
        ("validation", flat(value["validation"]) if value["validation"] else None),
        *value["about"].items(),
        ("params", flat(value["params"])),
        ("behind", ", then ".join(value["chain"]) or None),
        *_input_rows(value["inputs"]),
    ]
    return [_summary(value), "", *_align_columns(described)]


def _summary(value: ModelOverview) -> str:
    """Return architecture, task, number of epochs and validation result on one line, without those that are missing."""
    parts = [f"{value['architecture'] or 'a model'} for {value['task']}"]
    if value["epochs"]:
        parts.append(headline.format_count(value["epochs"], "epochs"))
    if value["validation"]:
        parts.append(f"validation: {flat(value['validation'])}")
    return "; ".join(parts)


def result_text(value: ResultOverview) -> list[str]:
    """Return the overview of a result as lines, starting with the headline table."""
    if value["headline"] is None:
        lines = ["This result was evaluated before headlines were kept: run `tacpipe evaluate` again to have them."]
    else:
        headlines = [headline.Headline.from_json(entry) for entry in value["headline"]]
        lines = headline_table.text(headlines, terminal.width_of(sys.stdout)).splitlines()
    parts = {name: flat(counts) for name, counts in value["by_part"].items()}
    fold = f", fold {value['fold']}" if value["role"] and value["fold"] is not None else ""
    described = [
        ("task", value["task"]),
        ("architecture", value["architecture"]),
        ("evaluated on", flat(value["evaluated_on"])),
        *((f"  {name}", text) for name, text in parts.items()),
        ("role", f"{value['role']}{fold}" if value["role"] else None),
        ("baselines", ", ".join(value["baselines"]) or None),
        ("params", flat(value["params"]) if value["params"] else None),
        *_named_once("trained on", _describe_training(value["trained_on"])),
        *_input_rows(value["inputs"]),
    ]
    return [*lines, "", *_align_columns(described)]


def flat(value: Any) -> str:
    """Return a nested value as one line; long lists are replaced by their length.

    >>> flat({"train": {"a": 35, "b": 33}, "val": 2, "names": []}), flat(list(range(20))), flat(None), flat(0.5)
    ('train a 35, train b 33, val 2', '20 values', '–', '0.5')
    """
    return ", ".join(f"{name} {described}".strip() for name, described in _leaves(value)) or headline.NONE


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, str]]:
    """Yield the path and the text of each value in nested values; long lists are replaced by their length."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _leaves(item, f"{name} {key}".strip().replace("_", " "))
    elif isinstance(value, list):
        if len(value) > SHOWN:
            yield name, f"{len(value)} values"
        elif value:
            yield name, " ".join(map(str, value))
    elif isinstance(value, float):
        yield name, f"{value:.6g}"
    elif value is not None and value != "":
        yield name, str(value)


def _architecture(config: Values) -> ModelOrigin:
    """Return the task and current architecture name of a configuration; both are None if it has none."""
    task, stored = config.get("task"), config.get("architecture")
    return {"task": task, "architecture": None if stored is None else headline_table.method(task, stored)}


def _describe_config(config: Values) -> ModelDescription:
    """Return the task, architecture, training data and other short entries of a configuration."""
    trained = config.get("trained_on")
    about = {}
    for name, entry in config.items():
        text = _short_text(entry)
        if name not in _APART and text is not None:
            about[name.replace("_", " ")] = text
    return {
        **_architecture(config),
        "trained_on": {
            # training and validation recordings
            "recordings": len(trained) if isinstance(trained, Mapping) else None,
            "roles": {role: count for role, count in config.get("counts", {}).items() if role in _ROLES},
        },
        "about": about,
    }


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


def _describe_training(trained: TrainingCounts) -> list[str]:
    """Return a line per role with its counts of training data, and a line with the number of recordings."""
    lines = [
        f"{role}: {flat(counts) if isinstance(counts, Mapping) else counts}"
        for role, counts in trained["roles"].items()
    ]
    count = trained["recordings"]
    return [*lines, *([headline.format_count(count, "recordings") + " of training and validation"] if count else [])]


def _input_rows(inputs: Mapping[str, Sequence[str]]) -> list[tuple[str, str]]:
    """Return rows of name and text for the inputs of a dataset; only the first of an argument has its name."""
    return [row for name, descriptions in inputs.items() for row in _named_once(name, descriptions)]


def _named_once(name: str, texts: Sequence[str]) -> list[tuple[str, str]]:
    """Return rows of name and text, of which only the first has the name."""
    return [(name if not index else "", text) for index, text in enumerate(texts)]


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


def _align_columns(described: list[tuple[str, Any]]) -> list[str]:
    """Return names and values in two aligned columns, with long values wrapped and values of None omitted."""
    filled = [(name, str(value)) for name, value in described if value is not None and value != ""]
    width = max((len(name) for name, _ in filled), default=0) + 2
    text_width = max(terminal.width_of(sys.stdout) - width, 20)
    rows = [row for name, value in filled for row in _named_once(name, _wrap_at_commas(value, text_width))]
    return [f"{name:<{width}}{line}" for name, line in rows]


def _wrap_at_commas(text: str, width: int) -> list[str]:
    """Return text wrapped after commas.

    >>> _wrap_at_commas("epochs 2, learning rate 0.002, seed 0", 20)
    ['epochs 2,', 'learning rate 0.002,', 'seed 0']
    """
    unbroken = text.replace(" ", "\0").replace(",\0", ", ")
    lines = textwrap.wrap(unbroken, width, break_long_words=False, break_on_hyphens=False)
    return [line.replace("\0", " ") for line in lines]


def files_text(files: Mapping[str, int], *, full: bool = False) -> list[str]:
    """Return names and sizes of files; only the count and the first names if there are many and ``full`` is false.

    >>> files_text({"config.json": 15696, "history.jsonl": 188})
    ['files  config.json 15.7 kB, history.jsonl 188 bytes']
    >>> " ".join(files_text(dict.fromkeys("abcdefgh", 1000))).split()[:5]
    ['files', '8,', 'together', '8.0', 'kB:']
    """
    names = [f"{name} {_size(size)}" for name, size in files.items()]
    if full or len(names) <= FILES + 1:
        return _align_columns([("files", ", ".join(names))])
    total = _size(sum(files.values()))
    text = f"{len(names)}, together {total}: {', '.join(names[:FILES])} and {len(names) - FILES} more"
    return _align_columns([("files", f"{text} (--full)")])


def _size(count: int) -> str:
    for factor, unit in ((1e6, "MB"), (1e3, "kB")):
        if count >= factor:
            return f"{count / factor:.1f} {unit}"
    return f"{count} bytes"
