"""Select recordings of a dataset by their names, their role in a split and their labels."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any

from tacpipe.channels.streams import TRUTH
from tacpipe.datasets import roles
from tacpipe.errors import UsageError
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import excerpt, listed, plain, suggestion

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Wanted

_SHOWN, _LABELS = 5, 12  # names or values, and labels, that an error lists


def roles_of(split: Dataset | None, role: str | None, fold: int) -> dict[str, str] | None:
    """Return recording to role in ``fold`` of an opened split, None without one.

    Raises `UsageError` where it is not a split or has no such fold, and for a role or a fold without a split.
    """
    if split is None:
        if role is not None or fold:
            raise UsageError(
                "A role and a fold are those of a split: give split too, as in select(split=PATH, role='test')."
            )
        return None
    place = str(split.path or "this dataset")
    roles.digest(split.source, place)
    (only,) = split
    rows = only.table(columns=["recording", "fold", "role"]).to_pydict()
    table = dict(zip(zip(rows["recording"], rows["fold"], strict=True), rows["role"], strict=True))
    return roles.in_fold(table, fold, place)


def chosen(
    dataset: Dataset,
    patterns: Sequence[str],
    roles: Mapping[str, str] | None,
    role: str | None,
    labels: Mapping[str, Wanted],
) -> list[str]:
    """Return the names of the recordings that match a pattern, have the role and meet each condition on a label.

    Raises `UsageError` where none does, and for a label that no recording has.
    """
    names = [
        name for name in dataset.recordings if not patterns or any(fnmatchcase(name, pattern) for pattern in patterns)
    ]
    if not names:
        existing = listed(dataset.recordings, _SHOWN)
        raise UsageError(f"No recording is named {' or '.join(patterns) or 'anything'}; there are {existing}.")
    if roles is not None:
        names = [name for name in names if name in roles and role in (None, roles[name])]
        if not names:
            existing = ", ".join(sorted(set(roles.values())))
            raise UsageError(
                f"No recording has the role {role or 'of any kind'} in this split; its roles are {existing}."
            )
    for label, condition in labels.items():
        names = _labelled(dataset, names, label, condition)
    return names


def unknown_label(dataset: Dataset, label: str) -> UsageError:
    """Return the error for a label that no recording has; it lists the existing labels."""
    existing = sorted({name for recording in dataset for name in recording.attributes if not name.startswith(TRUTH)})
    return UsageError(
        f"No recording has the label {plain(label)}; there are {listed(existing, _LABELS)}.{suggestion(label, existing)}"
    )


def _labelled(dataset: Dataset, names: Sequence[str], label: str, condition: Wanted) -> list[str]:
    values = {name: dataset[name].attributes[label] for name in names if label in dataset[name].attributes}
    if not values:
        raise unknown_label(dataset, label)
    meets = _test(condition)
    matching = [name for name, value in values.items() if meets(value)]
    if not matching:
        existing = listed(sorted({str(value) for value in values.values()}), _SHOWN)
        description = "a value that meets the condition" if callable(condition) else excerpt(condition)
        raise UsageError(f"No recording has {description} for the label {plain(label)}; its values are {existing}.")
    return matching


def _test(condition: Wanted) -> Callable[[Attribute], Any]:
    if callable(condition):
        return condition
    is_collection = isinstance(condition, Collection) and not isinstance(condition, str)
    values: Collection[Attribute] = condition if is_collection else (condition,)  # type: ignore[assignment]
    return lambda value: value in values
