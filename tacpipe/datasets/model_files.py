"""The files of a model or codec, which may be untrusted: JSON and safetensors, validated before they are used.

Neither format can contain code. A configuration is checked against the tensors: a network is first built without
memory, which is allocated only if all of its tensors are in the file with the same shapes.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.printable import excerpt, plain

if TYPE_CHECKING:
    import torch

    from tacpipe.arrays import AnyArray

CONFIG = "config.json"
MAX_SIZE = 100_000  # maximum number of rows, points or units, far above that of any model
_KINDS = {
    int: "a whole number",
    float: "a number",
    str: "a text",
    list: "a list",
    dict: "a mapping",
    bool: "true or false",
}
_MISFITS = (
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    RuntimeError,
    OverflowError,
    AssertionError,
    MemoryError,
)
Kind = type | tuple[type, ...]


@contextlib.contextmanager
def validated(noun: str) -> Iterator[None]:
    """Raise errors of the block about files that were created or edited by hand as a `TacpipeError` about ``noun``."""
    try:
        yield
    except TacpipeError:
        raise
    except (*_MISFITS, RecursionError) as error:
        described = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise TacpipeError(
            f"The files of {noun} do not fit one another ({plain(described, 200)}). Copy them again from their source, "
            f"or train one."
        ) from error


def task_name(files: Mapping[str, bytes], place: str = "This") -> str:
    """Return the name of the task of the model among ``files``.

    Raises `UsageError` if there is no model, `TacpipeError` if its configuration is invalid.
    """
    if CONFIG not in files:
        raise UsageError(f"{place} is not a model: it has no {CONFIG}. Give what `tacpipe train` wrote with -o.")
    return str(tree(files, CONFIG, {"task": str})["task"])


def tree(files: Mapping[str, bytes], name: str, needed: Mapping[str, Kind] | None = None) -> Any:
    """Return the mapping in a JSON file. ``needed`` maps the dotted names of required values to their types.

    Raises `TacpipeError` if it is not a mapping, a value is missing or has the wrong type, or a size is absurd.
    """
    try:
        content = json.loads(files[name])
    except (ValueError, RecursionError) as error:
        raise TacpipeError(f"{name} is not JSON ({plain(str(error), 100)}). Copy the model again.") from error
    if not isinstance(content, dict):
        raise TacpipeError(f"{name} holds {excerpt(content)}; it must be a mapping. Copy the model again.")
    for path, kind in (needed or {}).items():
        _require(name, path, _value_at(content, path), kind)
    return content


def to_json(tree: Mapping[str, object]) -> bytes:
    r"""Return the text of a JSON file of a model or a result: keys sorted, one per line.

    >>> to_json({"b": [1], "a": None})
    b'{\n "a": null,\n "b": [\n  1\n ]\n}\n'
    """
    return (json.dumps(tree, indent=1, sort_keys=True) + "\n").encode()


def to_csv(header: Sequence[str], rows: Iterable[Sequence[object]]) -> bytes:
    r"""Return the text of a CSV file of a result.

    >>> to_csv(("name", "n"), [("a", 1)])
    b'name,n\na,1\n'
    """
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([header, *rows])
    return text.getvalue().encode()


def tensors(content: bytes, name: str) -> dict[str, torch.Tensor]:
    """Return the tensors in a safetensors file, all finite. Raises `TacpipeError` if it is invalid."""
    from safetensors import SafetensorError
    from safetensors.torch import load

    with _readable(name, SafetensorError):
        tensors_by_name: dict[str, torch.Tensor] = load(content)
        _require_finite(name, {key: bool(value.isfinite().all()) for key, value in tensors_by_name.items()})
    return tensors_by_name


def arrays(content: bytes, name: str, *, but: str | None = None) -> dict[str, AnyArray]:
    """Return the arrays in a safetensors file, all finite except those whose names end with ``but``.

    Raises `TacpipeError` if it is invalid.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    with _readable(name, SafetensorError):
        arrays_by_name: dict[str, AnyArray] = load(content)
        described = {key: value for key, value in arrays_by_name.items() if but is None or not key.endswith(but)}
        _require_finite(name, {key: bool(np.isfinite(value).all()) for key, value in described.items()})
    return arrays_by_name


def build_with_weights(build: Callable[[], torch.nn.Module], weights: Mapping[str, torch.Tensor]) -> torch.nn.Module:
    """Return the network of ``build`` with these ``weights``. Memory is allocated only if they fit.

    Raises `TacpipeError` if a tensor is missing, unexpected, or of another shape.
    """
    import torch

    with validated("the model"), torch.device("meta"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch warns of layers without width, which are rejected below
        network = build()
    expected = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    shapes = {name: tuple(value.shape) for name, value in weights.items()}
    for name in sorted({*expected, *shapes}):
        if expected.get(name) != shapes.get(name):
            raise TacpipeError(
                f"The model's weights do not fit its {CONFIG}: {plain(name)} is {shapes.get(name, 'missing')} and should "
                f"be {expected.get(name, 'missing')}. Copy its files again from their source."
            )
    dtypes = {name: value.dtype for name, value in network.state_dict().items()}
    # `to_empty` imports sympy, which takes as long as a small network's evaluation
    network.load_state_dict({name: value.to(dtypes[name], copy=True) for name, value in weights.items()}, assign=True)
    return network


@contextlib.contextmanager
def _readable(name: str, kind: type[Exception]) -> Iterator[None]:
    """Raise errors of the block, or of the type ``kind``, as a `TacpipeError` about the safetensors file ``name``."""
    try:
        yield
    except (kind, ValueError, TypeError, LookupError, OverflowError, AttributeError, RuntimeError) as error:
        raise TacpipeError(
            f"{name} is not a safetensors file that can be read ({plain(' '.join(str(error).split()), 200)}). Copy it again "
            f"from its source."
        ) from error


def _require_finite(name: str, finite: Mapping[str, bool]) -> None:
    """Raise `TacpipeError` if the tensors of a file are not all ``finite``."""
    wrong = next((key for key, fine in finite.items() if not fine), None)
    if wrong is not None:
        raise TacpipeError(
            f"{name} holds values that are not finite (NaN) in {plain(wrong)}; nothing can be predicted from them. "
            f"Train the model again, or copy it from its source."
        )


def _value_at(value: Any, path: str) -> Any:
    for part in path.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    return value


def _require(name: str, path: str, value: Any, kind: Kind) -> None:
    """Raise `TacpipeError` unless a value of a file is of an allowed type, and an integer from 0 to `MAX_SIZE`."""
    kinds = kind if isinstance(kind, tuple) else (kind,)
    right = any(_is(value, allowed) for allowed in kinds)
    if not right:
        described = "is missing" if value is None else f"is {excerpt(value)}"
        description = " or ".join(_KINDS[allowed] for allowed in kinds)
        raise TacpipeError(
            f"{name}: {path} {described}; it must be {description}. Copy the model again from its source."
        )
    if isinstance(value, int) and not 0 <= value <= MAX_SIZE:
        raise TacpipeError(f"{name}: {path} is {excerpt(value)}; it must be from 0 to {MAX_SIZE}.")


def _is(value: Any, kind: type) -> bool:
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < float("inf")
    return isinstance(value, kind) and (kind is bool or not isinstance(value, bool))
