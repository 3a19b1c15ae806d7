"""What is seen while a rig records: a table and a heat map of the taxels on a terminal, plain lines elsewhere."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from tacpipe import printable
from tacpipe.io import progress, terminal
from tacpipe.recording import clock
from tacpipe.recording.watch import Figures, Watch, tactile_channels

FRAMES_HZ = 8.0  # of the view on a terminal
LINE_S = 5.0  # between two plain lines
SHADES = ("grey15", "dark_blue", "blue", "dark_cyan", "green", "yellow", "orange1", "red")
COLUMNS = 16  # of the heat map, at most


class View:
    """Shows the watches of a rig; `show` may be called as often as one likes."""

    def __init__(
        self, watches: Mapping[str, Watch], *, quiet: bool = False, more: Callable[[], Sequence[str]] = lambda: ()
    ) -> None:
        self._watches, self._quiet = watches, quiet
        self._more = more  # returns further lines, below the streams
        self._live: Any = None
        self._shown_s = clock.now_s()
        self._tactile = {
            name: [place for place, _ in tactile_channels(watch.stream)] for name, watch in watches.items()
        }
        self._most = dict.fromkeys(watches, 1.0)

    @contextlib.contextmanager
    def open(self) -> Iterator[View]:
        """Have the view on the terminal while in the block, where there is one."""
        if self._quiet or not progress.is_visible():
            yield self
            return
        from rich.console import Console
        from rich.live import Live

        with Live(console=Console(file=sys.stderr), refresh_per_second=FRAMES_HZ, transient=True) as self._live:
            yield self
        self._live = None

    def show(self, state: str) -> None:
        """Show what the streams do now, and ``state``: what the rig is doing."""
        now_s = clock.now_s()
        if self._quiet or now_s - self._shown_s < (1 / FRAMES_HZ if self._live else LINE_S):
            return
        self._shown_s = now_s
        figures = {name: watch.figures(clock.now_ns()) for name, watch in self._watches.items()}
        if self._live is not None:
            self._live.update(self._picture(state, figures))
        else:
            described = "; ".join(line(name, found) for name, found in figures.items())
            terminal.note(f"{state}: {described}")
            for one in self._more():
                terminal.note(one)

    def _picture(self, state: str, figures: Mapping[str, Figures]) -> Any:
        from rich.console import Group
        from rich.table import Table
        from rich.text import Text

        table = Table(
            "stream", "Hz", "jitter ms", "latency ms", "samples", "lost", "bytes lost", title=printable.shown(state)
        )
        for name, found in figures.items():
            latency = "" if found.latency_ms is None else f"{found.latency_ms:.2f}"
            row = (f"{found.rate_hz:.1f}", f"{found.jitter_ms:.2f}", latency, str(found.samples))
            table.add_row(name, *row, str(found.lost), str(found.bytes_lost), style="red" if found.lost else None)
        maps = [Text.assemble(name + "\n", *self._heat(name)) for name in figures if self._tactile[name]]
        return Group(table, *(Text(printable.shown(one)) for one in self._more()), *maps)

    def _heat(self, name: str) -> list[Any]:
        """Return the tactile channels of a stream as coloured cells, by how far each is from rest."""
        watch, places = self._watches[name], self._tactile[name]
        if watch.newest is None or watch.rest is None:
            return []
        away = np.abs(watch.newest[places] - watch.rest[places])
        self._most[name] = max(self._most[name], float(away.max()))
        shade = np.minimum(away / self._most[name] * len(SHADES), len(SHADES) - 1).astype(int)
        cells: list[Any] = []
        for number, one in enumerate(shade.tolist()):
            cells.append(("  ", f"on {SHADES[one]}"))
            if (number + 1) % COLUMNS == 0:
                cells.append("\n")
        return cells


def line(name: str, found: Figures) -> str:
    """Return what a stream does as words.

    >>> line("xela1", Figures(50.02, 0.41, None, 120, 1, 0))
    'xela1 50.0 Hz, jitter 0.4 ms, 120 samples, 1 lost'
    """
    latency = "" if found.latency_ms is None else f", latency {found.latency_ms:.1f} ms"
    kept = f"{found.samples} samples, {found.lost} lost"
    return f"{name} {found.rate_hz:.1f} Hz, jitter {found.jitter_ms:.1f} ms{latency}, {kept}"
