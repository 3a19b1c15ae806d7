"""A page of sections, written as one HTML file that loads nothing: style, script and the charts' library stand in it."""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Sequence
from importlib import resources
from typing import TYPE_CHECKING, Any

from tacpipe.plugins import extras
from tacpipe.report.blocks import Block, Chart, Charts, Fold, Section

if TYPE_CHECKING:
    from markupsafe import Markup

LIBRARY = "vl_convert"  # brings Vega and Vega-Lite as JavaScript
COMMAND = re.compile(r"`([^`]+)`")


def page(sections: Sequence[Section], title: str, heading: str = "") -> bytes:
    """Return the page as UTF-8; the same sections give the same bytes."""
    with extras.named("A report"):
        import jinja2
        from markupsafe import Markup

        charts = any(_charts(one) for one in sections)
        library = bundle() if charts else ""
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(_template), autoescape=True, trim_blocks=True, lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )  # fmt: skip
    environment.filters |= {"spec": _spec, "commands": _commands}
    parts: dict[str, Any] = {
        "style": Markup(_template("page.css")),
        "script": Markup(_template("page.js")),
        "library": Markup(library),
    }
    found = environment.get_template("page.html").render(
        sections=sections, title=title, heading=heading, charts=charts, **parts
    )
    return f"{found}\n".encode()


@functools.cache
def bundle() -> str:
    """Return Vega, Vega-Lite and Vega-Embed as one script, which puts ``vegaEmbed`` into the window."""
    import vl_convert

    script: str = vl_convert.javascript_bundle(snippet="window.vegaEmbed = vegaEmbed;")
    safe = script.replace("</script", "<\\/script")
    return f"(() => {{{safe}}})();"  # its own names stay in it


def _template(name: str) -> str:
    return (resources.files("tacpipe.report") / "templates" / name).read_text(encoding="utf-8")


def _spec(spec: Any) -> Markup:
    """Return a chart's specification as JSON that no text in it can end, its data by column."""
    from markupsafe import Markup

    text = json.dumps(_packed(spec), sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=False)
    return Markup(text.replace("<", "\\u003c"))


def _packed(spec: Any) -> Any:
    """Return a specification whose data are by column: what is the same in all rows once, other texts by their place.

    >>> _packed({"data": {"values": [{"a": 1, "b": "x"}, {"a": 2, "b": "x"}]}})
    {'data': {'rows': 2, 'columns': {'a': [1, 2], 'b': {'of': ['x'], 'at': 0}}}}
    """
    if isinstance(spec, dict):
        if set(spec) == {"values"} and isinstance(spec["values"], list):
            rows = spec["values"]
            names = dict.fromkeys(name for row in rows for name in row)
            return {"rows": len(rows), "columns": {name: _column([row.get(name) for row in rows]) for name in names}}
        return {name: _packed(value) for name, value in spec.items()}
    return [_packed(one) for one in spec] if isinstance(spec, list | tuple) else spec


def _column(values: list[Any]) -> Any:
    distinct = list(dict.fromkeys((type(one), one) for one in values))
    if len(distinct) == 1 and len(values) > 1:
        return {"of": [values[0]], "at": 0}
    if all(isinstance(one, int | float) or one is None for one in values) and not any(
        isinstance(one, bool) for one in values
    ):
        return values
    places = {one: place for place, one in enumerate(distinct)}
    return {"of": [one for _, one in distinct], "at": [places[type(one), one] for one in values]}


def _commands(text: str) -> Markup:
    """Return text in which what stands in backquotes is code that a click copies."""
    from markupsafe import Markup, escape

    return Markup(COMMAND.sub(r'<code data-copy="" title="click to copy">\1</code>', str(escape(text))))


def _charts(section: Section) -> bool:
    """Return whether a section holds any chart."""

    def inside(block: Block) -> bool:
        return isinstance(block, Chart | Charts) or (isinstance(block, Fold) and any(map(inside, block.blocks)))

    return section.chart is not None or any(map(inside, section.folds))
