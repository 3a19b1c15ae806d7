"""One page of results, each task's part by the module that its plug-in brings for it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

from tacpipe.datasets import model_files
from tacpipe.errors import TacpipeError
from tacpipe.plugins import registry
from tacpipe.report import contents, markup, plain

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset


def render(given: Sequence[Dataset], *, title: str = "", traces: int = 2) -> bytes:
    """Return the page for results of ``tacpipe evaluate``, as UTF-8; the same results give the same bytes.

    Without a ``title``, it is made of what the tasks on the page predict.
    Results are reported by task, in the order in which tasks first come, with datasets that are not results next to those
    whose task can use them. Raises `TacpipeError` where none can, and without any result.
    """
    with model_files.validated("the results"):
        return _rendered(given, title, traces)


def _rendered(given: Sequence[Dataset], title: str, traces: int) -> bytes:
    results: dict[str, list[Dataset]] = {}
    others = []
    for one in given:
        if "metrics.json" in one.files:
            results.setdefault(_task(one), []).append(one)
        else:
            others.append(one)
    loaded = {name: registry.load_report(name) for name in results}
    packages: dict[str, Any] = {name: package for name, package in loaded.items() if package is not None}
    if not results or not all(_users(one, packages) for one in others):
        raise TacpipeError("There is no metrics.json in this dataset. Give the output of `tacpipe evaluate`.")
    title = title or _title(results, packages)
    parts = []
    for name, found in results.items():
        if name in packages:
            besides = [one for one in others if name in _users(one, packages)]
            parts.append(packages[name].report(found, besides, traces))
        else:
            parts += [plain.render(one, number, len(found)) for number, one in enumerate(found, 1)]
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{markup.STYLE}</style></head>\n'
        f"<body><h1>{escape(title)}</h1>\n{''.join(parts)}</body></html>\n"
    ).encode()


def _title(tasks: Iterable[str], packages: dict[str, Any]) -> str:
    """Return what the tasks on a page are about."""
    titles = [str(packages[name].TITLE) if name in packages else name.replace("_", " ") for name in tasks]
    title = markup.listed([one for one in titles if one]) or "results"
    return f"{title[0].upper()}{title[1:]}"


def _task(result: Dataset) -> str:
    """Return the task of a result, empty where it does not state."""
    return str(contents.tree(result, "config.json").get("task", ""))


def _users(dataset: Dataset, packages: dict[str, Any]) -> list[str]:
    """Return the tasks whose part of the page can use a dataset that is not a result."""
    return [name for name, package in packages.items() if package.reads(dataset)]
