"""One page of results: how all compare, then single ones in full."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING

from tacpipe.errors import TacpipeError
from tacpipe.report import markup, methods, overview, section, sweep
from tacpipe.report.overview import Overview

if TYPE_CHECKING:
    from tacpipe.dataset import Dataset

IN_FULL = 2  # results that are told in full where there are no more


def render(given: Sequence[Dataset], *, title: str, traces: int = 2) -> bytes:
    """Return the page for results of ``tacpipe evaluate``, as UTF-8; the same results give the same bytes.

    Several results that can be compared are, and of more than two only a few are told in full. Datasets of ``tacpipe
    compress`` among them tell of their codecs. Raises `TacpipeError` where a dataset is neither, and without any result.
    """
    results = [one for one in given if "metrics.json" in one.files]
    others = [one for one in given if "metrics.json" not in one.files]
    if not results or any(sweep.FILE not in one.files for one in others):
        raise TacpipeError("There is no metrics.json in this dataset. Give the output of `tacpipe evaluate`.")
    read = [methods.Run.read(one) for one in results if methods.comparable(one)]
    runs = [run for run in read if run.errors.recordings]  # others have nothing to compare
    told, parts = results, []
    if len(runs) > 1:
        found = Overview(runs)
        simulated = any(section.simulated(run.dataset) for run in runs)
        parts.append(overview.render(found, sweep.read(given), simulated))
        if len(runs) > IN_FULL:
            compared = {id(run.dataset) for run in runs}
            chosen = [run.dataset for run in found.told_apart()]
            told = [*chosen, *(one for one in results if id(one) not in compared)]
            parts.append(markup.note(f"Below, {len(told)} of the {len(results)} results in full."))
    elif others:
        parts.append(overview.codec_section(sweep.read(given)))
    parts += [section.render(one, number, len(told), traces) for number, one in enumerate(told, 1)]
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{markup.STYLE}</style></head>\n'
        f"<body><h1>{escape(title)}</h1>\n{''.join(parts)}</body></html>\n"
    ).encode()
