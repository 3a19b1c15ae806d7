"""All that the page reports on touch: what came out, tables by split, the paper's forms, then what single grasps look
like."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING

from tacpipe.report import headline_box, markup, provenance
from tacpipe.report.touch import clouds, curves, electrodes, forms, generalisation, headline, pressure, tables, wording
from tacpipe.report.touch import methods as by_method
from tacpipe.report.touch.methods import Group, Method

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

BADGE = ' <span class="badge">simulated</span>'
MIXED = " What is marked simulated is not evidence about a real sensor."
POOLED = (
    "PDC is the pressure of the fluid in a fingertip. RMSE is global, over all grasps and electrodes of all runs of a "
    "method, as a fraction of the target's fixed range and in device counts; over runs it is mean ± standard "
    "deviation; batch mean is the mean RMSE of batches of 10. Skill is 1 − RMSE / RMSE of the constant on the same "
    "grasps, with the 95 % interval from drawing grasps anew (known objects) or objects (novel ones). R² is about the "
    "mean of the evaluated grasps, so a constant lies at 0 or below. A novel object has no mean of its own: the "
    "constant represents it. "
)


def render(methods: Sequence[Method], grasps: Sequence[Dataset]) -> str:
    """Return the part of the page that reports on the task ``touch``."""
    parted = by_method.groups(methods)
    simulated = all(one.simulated for one in methods)
    badge = BADGE if simulated else ""
    runs = sum(len(one.runs) for one in methods)
    several = f"{len(methods)} methods in {runs} results" if runs > 1 else methods[0].name
    statements = headline.sentences(parted)
    first = parted[0].default
    chosen = {one.recording: f"{one.place} by error" for one in electrodes.chosen(first.runs)}
    forms_text = forms.section(methods) + generalisation.section(methods) + curves.figure_8(methods)
    published = all(one.published for one in methods)
    title = "The paper's tables and figures" if published else "What settings change"
    parts = [
        f"<h2>{'Touch from clouds: ' if runs > 1 else ''}{escape(several)}{badge}</h2>",
        headline_box.box(statements),
        headline_box.table(headline.headlines(parted)),
        markup.note(wording.caution(methods) + (MIXED if simulated != parted[-1].simulated else "")),
        *(_group(group, len(parted) > 1) for group in parted),
        f"<h3>The pressure, {escape(first.name)}</h3>" + pressure.section(first),
        electrodes.section(first),
        clouds.section(grasps, chosen),
        f"<h3>{title}</h3>{forms_text}" if forms_text else "",
        "<h3>All runs</h3>",
        tables.every_run(methods),
        _source(first),
    ]
    return "\n".join(part for part in parts if part) + "\n"


def _group(group: Group, several: bool) -> str:
    """Return the tables of one way to part grasps."""
    badge = BADGE if group.simulated else ""
    title = f"Errors: {wording.split(group.split)}" if several else "Errors"
    caution = markup.note(wording.caution(group.methods))
    described = [tables.errors(group, known) for known in (True, False)]
    parts = [f"<h3>{escape(title)}{badge}</h3>", markup.note(f"{wording.basis(group.methods)} {POOLED}")]
    parts += [f"{one}{caution}" for one in (*described, tables.by_object(group)) if one]
    return "".join([*parts, curves.section(group)])


def _source(method: Method) -> str:
    """Return where the first run of a method comes from."""
    run = method.runs[0]
    params = ", ".join(f"{name} = {json.dumps(value)}" for name, value in sorted(run.params.items()))
    return markup.note(f"A run of {method.name}, trained with {params}.") + provenance.section(run.dataset.manifest)
