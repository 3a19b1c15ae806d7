"""The text beside a recording in the viewer: its labels, streams and what the views show."""

from __future__ import annotations

from tacpipe.printable import plain
from tacpipe.viewer.contents import Contents

MOST = 40  # labels


def text(contents: Contents) -> str:
    """Return the labels, streams and events of a recording as Markdown."""
    lines = [f"# {plain(contents.name)}", "", f"{contents.duration_s:.3g} s", ""]
    labels = contents.labels
    if labels:
        lines += ["| label | value |", "| --- | --- |"]
        lines += [f"| {_cell(name)} | {_cell(value)} |" for name, value in list(labels.items())[:MOST]]
        lines += [f"| … | {len(labels) - MOST} more |"] if len(labels) > MOST else []
    lines += ["", "| stream | rows | Hz |", "| --- | --- | --- |"]
    lines += [
        f"| {_cell(name or '-')} | {rows} | {rate_hz or ''} |" for name, (rows, rate_hz) in contents.rates.items()
    ]
    if contents.named:
        lines += ["", "| predictor | " + _cell(contents.named.key) + " |", "| --- | --- |"]
        lines += [f"| {_cell(name)} | {_cell(value)} |" for name, value in contents.named.predicted.items()]
        lines += [f"| the label | {_cell(contents.named.label)} |"] if contents.named.label else []
    elif contents.predicted:
        lines += ["", "| predicted | value |", "| --- | --- |"]
        lines += [f"| {_cell(name)} | {_cell(value)} |" for name, value in list(contents.predicted.items())[:MOST]]
    lines += [
        "",
        "**Maps of taxels**: colour is the distance from rest, an arrow the shear along x and y.",
    ]
    lines += ["**Touch**: the mean of these distances over the taxels of a finger."]
    return "\n".join(lines)


def _cell(value: object) -> str:
    shown = f"{value:g}" if isinstance(value, float) else str(value)
    return plain(shown).replace("|", "\\|")
