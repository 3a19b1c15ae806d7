"""Render one page with the results of all tasks, as a self-contained HTML file."""

from __future__ import annotations

import base64
import functools
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import TYPE_CHECKING, Any

from tacpipe.comparison.runs import by_task, report_on
from tacpipe.datasets import model_files
from tacpipe.errors import TacpipeError
from tacpipe.plugins import extras
from tacpipe.printable import listed
from tacpipe.report.blocks import Block, Chart, Charts, Fold, Section
from tacpipe.report.context import TaskReport
from tacpipe.report.frames import holds_cameras
from tacpipe.report.sections import section

if TYPE_CHECKING:
    from markupsafe import Markup

    from tacpipe.datasets.dataset import Dataset


COMMAND = re.compile(r"`([^`]+)`")


def page(sections: Sequence[Section], title: str, heading: str = "") -> bytes:
    """Return the page as UTF-8; equal sections give equal bytes.

    Raises `MissingModuleError` if an extra is not installed.
    """
    with extras.explain_missing("A report"):
        import jinja2
        from markupsafe import Markup

        has_charts = any(_has_charts(section) for section in sections)
        library = bundle() if has_charts else ""
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(_template), autoescape=True, trim_blocks=True, lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )  # fmt: skip
    environment.filters |= {"spec": _spec_markup, "commands": _mark_commands}
    parts = {
        "style": Markup(_template("page.css")),
        "script": Markup(_template("page.js")),
        "library": Markup(library),
    }
    policy = _content_policy(parts["style"], [parts["script"], *([library] if has_charts else [])])
    text = environment.get_template("page.html").render(
        sections=sections, title=title, heading=heading, charts=has_charts, policy=policy, **parts
    )
    return f"{text}\n".encode()


def _content_policy(style: str, scripts: Sequence[str]) -> str:
    """Return the policy that a browser enforces: only this style, these scripts and embedded images; no connections."""

    def source(text: str) -> str:
        return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"

    return (
        f"default-src 'none'; script-src {' '.join(map(source, scripts))}; style-src {source(style)}; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )


@functools.cache
def bundle() -> str:
    """Return Vega, Vega-Lite and Vega-Embed as one script that defines ``window.vegaEmbed``."""
    import vl_convert

    script: str = vl_convert.javascript_bundle(snippet="window.vegaEmbed = vegaEmbed;")
    safe = script.replace("</script", "<\\/script")
    return f"(() => {{{safe}}})();"  # the function keeps the names of the script local


def _template(name: str) -> str:
    return (resources.files("tacpipe.report") / "templates" / name).read_text(encoding="utf-8")


def _spec_markup(spec: Any) -> Markup:
    """Return a chart's specification as packed JSON, with "<" escaped so that no text in it can end the script element."""
    from markupsafe import Markup

    text = json.dumps(_pack_spec(spec), sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=False)
    return Markup(text.replace("<", "\\u003c"))


def _pack_spec(spec: Any) -> Any:
    """Return a chart specification with its data stored by column: constants once, texts as indices.

    >>> _pack_spec({"data": {"values": [{"a": 1, "b": "x"}, {"a": 2, "b": "x"}]}})
    {'data': {'rows': 2, 'columns': {'a': [1, 2], 'b': {'of': ['x'], 'at': 0}}}}
    """
    if isinstance(spec, dict):
        if set(spec) == {"values"} and isinstance(spec["values"], list):
            rows = spec["values"]
            names = dict.fromkeys(name for row in rows for name in row)
            return {
                "rows": len(rows),
                "columns": {name: _pack_column([row.get(name) for row in rows]) for name in names},
            }
        return {name: _pack_spec(value) for name, value in spec.items()}
    return [_pack_spec(item) for item in spec] if isinstance(spec, list | tuple) else spec


def _pack_column(values: list[Any]) -> Any:
    """Return a column packed: numbers as they are, a constant once, other values as distinct values and their indices."""
    distinct = list(dict.fromkeys((type(value), value) for value in values))
    if len(distinct) == 1 and len(values) > 1:
        return {"of": [values[0]], "at": 0}
    if all(value is None or (isinstance(value, int | float) and not isinstance(value, bool)) for value in values):
        return values
    indices = {typed_value: index for index, typed_value in enumerate(distinct)}
    return {"of": [value for _, value in distinct], "at": [indices[type(value), value] for value in values]}


def _mark_commands(text: str) -> Markup:
    """Return text with its parts in backquotes marked as code that is copied on a click."""
    from markupsafe import Markup, escape

    return Markup(COMMAND.sub(r'<code data-copy="" title="click to copy">\1</code>', str(escape(text))))


def _has_charts(section: Section) -> bool:
    """Return whether a section contains a chart, also in nested folds."""

    def has_chart(block: Block) -> bool:
        return isinstance(block, Chart | Charts) or (isinstance(block, Fold) and any(map(has_chart, block.blocks)))

    return section.chart is not None or any(map(has_chart, section.folds))


def render(datasets: Sequence[Dataset], *, title: str = "", traces: int = 2) -> bytes:
    """Return the page for results of ``tacpipe evaluate`` as UTF-8; equal results give equal bytes.

    The default ``title`` consists of the predicted quantities. Results are grouped by task in order of appearance, with
    other datasets in the sections of tasks that can use them. ``traces`` is the number of recordings that are drawn
    completely. Raises `TacpipeError` if no task can use a dataset, or if there is no result.
    """
    with model_files.validated("the results"):
        return _render(datasets, title, traces)


def _render(datasets: Sequence[Dataset], title: str, traces: int) -> bytes:
    """Return the page as `render` does, without its check of result files. Raises `TacpipeError` as `render` does."""
    results = [dataset for dataset in datasets if "metrics.json" in dataset.files]
    extra_datasets = [dataset for dataset in datasets if "metrics.json" not in dataset.files]
    tasks = {name: report_on(name, TaskReport) for name in by_task(results)}
    if not results or not all(_tasks_using(dataset, tasks) for dataset in extra_datasets):
        raise TacpipeError("There is no metrics.json in this dataset. Give the output of `tacpipe evaluate`.")
    sections = []
    for name, task_results in by_task(results).items():
        used_datasets = [dataset for dataset in extra_datasets if name in _tasks_using(dataset, tasks)]
        sections.append(section(tasks[name], task_results, used_datasets, traces))
    titles = [section.title for section in sections]
    return page(
        sections, title or listed([*titles[:1], *(title[:1].lower() + title[1:] for title in titles[1:])]), title
    )


def _tasks_using(dataset: Dataset, tasks: Mapping[str, TaskReport]) -> list[str]:
    """Return the tasks whose section can use a dataset that is not a result."""
    with_outcomes = [name for name, task in tasks.items() if type(task).outcomes is not TaskReport.outcomes]
    if with_outcomes and holds_cameras(dataset):
        return with_outcomes
    return [name for name, task in tasks.items() if task.uses(dataset)]
