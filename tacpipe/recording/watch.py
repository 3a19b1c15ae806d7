"""Compute and show live figures of a rig's streams: rate, losses, jitter, latency, newest values."""

from __future__ import annotations

import contextlib
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np

from tacpipe import printable
from tacpipe.arrays import Floats, Int64s
from tacpipe.errors import TacpipeError
from tacpipe.io import terminal
from tacpipe.recording import clock
from tacpipe.recording.pace import STALLED, parse_stall
from tacpipe.recording.reading import Batch, LinkReader
from tacpipe.recording.rig import RigStream
from tacpipe.recording.spool import StreamNote
from tacpipe.recording.station import FOREIGN, LOST, OPENED, OVERRUN, REFUSED
from tacpipe.sensors.framing import Chunks

WINDOW_NS = 2_000_000_000  # window over which rate and jitter are measured
SILENT_S = 2.0  # a stream that sends continuously counts as lost after this time without a sample
REST_S = 0.5  # window over which the rest level of a tactile channel is averaged


@dataclass(frozen=True)
class Figures:
    """The current figures of a stream."""

    rate_hz: float
    jitter_ms: float  # standard deviation of the time between arrivals
    latency_ms: float | None  # median delay relative to the fastest sample, by the device's clock; None without a clock
    samples: int  # total
    lost: int  # total, without estimated losses
    lost_estimated: int  # total
    bytes_lost: int  # total


class Watch:
    """Decode one stream, and retain only its newest samples."""

    def __init__(self, stream: RigStream) -> None:
        self.stream = stream
        self.samples = 0
        self.error = ""  # the last error of the stream's driver
        self.newest: Floats | None = None  # (channel,)
        self.newest_packet: bytes | None = None  # the newest frame of a camera
        self.heard: deque[Chunks] = deque(maxlen=64)  # the last chunks, to identify the device if they contain no frame
        self.last_ns: int | None = None  # arrival of the newest sample
        self.notes: deque[StreamNote] = deque(maxlen=64)  # notes that are not shown yet
        self._reader = LinkReader(stream.sensor)
        self._recent: deque[tuple[Int64s, Int64s | None]] = deque()
        self._rest_samples: list[Floats] = []
        self.rest_level: Floats | None = None  # (channel,), None until it is measured

    def feed(self, blocks: list[Chunks | StreamNote]) -> None:
        """Decode blocks. A driver's error is stored in ``error``, because a watch must not end a recording."""
        for block in blocks:
            if isinstance(block, Chunks):
                self.heard.append(block)
            else:
                self.notes.append(block)
            try:
                if isinstance(block, Chunks):
                    self._add_batch(self._reader.feed(block))
                elif block.what == LOST:
                    self._add_batch(self._reader.end_link())
            except Exception as error:
                self.error = str(error) if isinstance(error, TacpipeError) else f"{type(error).__name__}: {error}"
                self._reader = LinkReader(self.stream.sensor)

    def figures(self, now_ns: int) -> Figures:
        """Return the figures over the last `WINDOW_NS` before ``now_ns`` on the monotonic clock."""
        self._drop_old(now_ns)
        t_ns = np.concatenate([stamps for stamps, _ in self._recent] or [np.zeros(0, dtype=np.int64)])
        steps_ns = np.diff(t_ns)
        rate_hz = float((len(t_ns) - 1) * 1e9 / (t_ns[-1] - t_ns[0])) if len(t_ns) > 1 and t_ns[-1] > t_ns[0] else 0.0
        jitter_ms = float(steps_ns.std() / 1e6) if len(steps_ns) else 0.0
        device = [stamps for _, stamps in self._recent if stamps is not None]
        latency_ms = None
        if device and len(device) == len(self._recent):
            late_ns = t_ns - np.concatenate(device)
            latency_ms = float(np.median(late_ns - late_ns.min()) / 1e6)
        losses, bytes_lost = self._reader.losses, self._reader.account.lost
        return Figures(rate_hz, jitter_ms, latency_ms, self.samples, losses.certain, losses.estimated, bytes_lost)

    def tare(self) -> None:
        """Measure the rest level again from the next samples."""
        self._rest_samples, self.rest_level = [], None

    def _add_batch(self, batch: Batch) -> None:
        """Update the newest values, the window of rate and jitter, and the rest level."""
        if not len(batch):
            return
        self.samples += len(batch)
        self.last_ns = int(batch.t_ns[-1])
        self._recent.append((batch.t_ns, batch.t_device_ns))
        self._drop_old(self.last_ns)
        packets = [block[-1, 0] for block in batch.values if block.dtype.kind == "O"]
        self.newest_packet = next((packet for packet in packets if isinstance(packet, bytes)), self.newest_packet)
        numbers = [block[-1].astype(np.float64) for block in batch.values if block.dtype.kind in "iufb"]
        self.newest = np.concatenate(numbers) if numbers else None
        if self.rest_level is None and self.newest is not None:
            self._rest_samples.append(self.newest)
            rest_count = REST_S * (self.stream.sensor.rate_hz or 1.0)
            if len(self._rest_samples) >= min(10.0, max(1.0, rest_count)):
                self.rest_level = np.mean(self._rest_samples, axis=0)

    def _drop_old(self, now_ns: int) -> None:
        while self._recent and self._recent[0][0][-1] < now_ns - WINDOW_NS:
            self._recent.popleft()


def tactile_channels(stream: RigStream) -> list[tuple[int, Any]]:
    """Return (position among the numeric channels, field) of each tactile channel of a stream."""
    import pyarrow as pa

    numeric = [
        field
        for field in stream.sensor.fields()
        if pa.types.is_integer(field.type) or pa.types.is_floating(field.type) or pa.types.is_boolean(field.type)
    ]
    return [
        (position, field)
        for position, field in enumerate(numeric)
        if (field.metadata or {}).get(b"quantity") == b"tactile"
    ]


REFRESH_HZ = 8.0  # refresh rate on a terminal
LINE_S = 5.0  # period of plain lines without a terminal
STALL_LINES_NS = 5_000_000_000  # minimum time between two lines about delays, which each stream notes
SHADES = ("grey15", "dark_blue", "blue", "dark_cyan", "green", "yellow", "orange1", "red")
MAX_COLUMNS = 16  # maximum number of columns of the heat map


class RigView:
    """Show the figures of a rig's streams. `show` may be called at any rate."""

    def __init__(
        self, watches: Mapping[str, Watch], *, quiet: bool = False, footer: Callable[[], Sequence[str]] = lambda: ()
    ) -> None:
        self._watches, self._quiet = watches, quiet
        self._footer = footer  # returns lines to show below the streams
        self._live: Any = None
        self._shown_s = clock.now_s()
        self._tactile = {
            name: [position for position, _ in tactile_channels(watch.stream)] for name, watch in watches.items()
        }
        self._largest = dict.fromkeys(watches, 1.0)
        self._lost: set[str] = set()  # streams whose link is lost
        self._silent: set[str] = set()  # streams that are open and send nothing
        self._stall_ns = -STALL_LINES_NS  # time of the last line about a delay of this program

    @contextlib.contextmanager
    def open(self) -> Iterator[RigView]:
        """Show the view during the block if there is a terminal."""
        if self._quiet or not terminal.is_visible():
            yield self
            return
        from rich.console import Console
        from rich.live import Live

        with Live(console=Console(file=sys.stderr), refresh_per_second=REFRESH_HZ, transient=True) as self._live:
            yield self
        self._live = None

    def show(self, state: str, warning: str = "") -> None:
        """Show the figures of the streams, ``state``, a description of the rig's activity, and a line for each new event.

        A ``warning`` is an event of this moment.
        """
        now_s = clock.now_s()
        for event in [] if self._quiet else self._new_events(warning):
            if self._live is not None:
                self._live.console.print(printable.shown(event), markup=False, highlight=False, soft_wrap=True)
            else:
                terminal.note(event)
        if self._quiet or now_s - self._shown_s < (1 / REFRESH_HZ if self._live else LINE_S):
            return
        self._shown_s = now_s
        figures = {name: watch.figures(clock.now_ns()) for name, watch in self._watches.items()}
        if self._live is not None:
            self._live.update(self._render(state, figures))
        else:
            summary = "; ".join(describe_figures(name, values) for name, values in figures.items())
            terminal.note(f"{state}: {summary}")
            for footer_line in self._footer():
                terminal.note(footer_line)

    def _new_events(self, warning: str) -> list[str]:
        """Return a line with the time of day for each event since the last call: a loss, a silence, dropped data."""
        now_ns = clock.now_ns()
        events = [(now_ns, warning)]
        for name, watch in self._watches.items():
            while watch.notes:
                note = watch.notes.popleft()
                events.append((note.t_ns, self._describe_note(name, note)))
            last_ns = watch.last_ns
            if not watch.stream.sensor.awaited or last_ns is None or name in self._lost:
                continue
            is_silent = now_ns - last_ns > SILENT_S * 1e9
            if is_silent and name not in self._silent:
                self._silent.add(name)
                events.append((last_ns, f"Stream {name} sends nothing from now on, though its link is open."))
            elif not is_silent and name in self._silent:
                self._silent.remove(name)
                events.append((last_ns, f"Stream {name} sends again."))
        offset_ns = time.time_ns() - now_ns
        times = ((datetime.fromtimestamp((t_ns + offset_ns) / 1e9), text) for t_ns, text in events if text)
        return [f"{moment:%H:%M:%S} {text}" for moment, text in times]

    def _describe_note(self, name: str, note: StreamNote) -> str:
        """Return a note as a sentence, or nothing for one that users need not know."""
        if note.what == LOST:
            self._lost.add(name)
            return note.detail  # a sentence that names the stream
        if note.what == OPENED and name in self._lost:
            self._lost.remove(name)
            return f"Stream {name} is open again."
        if note.what == OVERRUN:
            return f"Stream {name}: {note.detail} overruns of its link, whose data are lost."
        if note.what in (FOREIGN, REFUSED):
            return f"Stream {name}: {note.detail}."
        stall = parse_stall(note.detail) if note.what == STALLED else None
        if stall is None or note.t_ns - self._stall_ns < STALL_LINES_NS:
            return ""
        self._stall_ns = note.t_ns
        return f"This program was delayed by {stall.duration_ns / 1e6:.0f} ms, so arrival times are late."

    def _render(self, state: str, figures: Mapping[str, Figures]) -> Any:
        """Return a table of the figures, the footer and the heat maps for the terminal."""
        from rich.console import Group
        from rich.table import Table
        from rich.text import Text

        table = Table(
            "stream", "Hz", "jitter ms", "latency ms", "samples", "lost", "bytes lost", title=printable.shown(state)
        )
        for name, values in figures.items():
            latency = "" if values.latency_ms is None else f"{values.latency_ms:.2f}"
            row = (f"{values.rate_hz:.1f}", f"{values.jitter_ms:.2f}", latency, str(values.samples))
            lost = str(values.lost) + f" + about {values.lost_estimated}" * (values.lost_estimated > 0)
            table.add_row(name, *row, lost, str(values.bytes_lost), style="red" if values.lost else None)
        maps = [Text.assemble(name + "\n", *self._heat_map(name)) for name in figures if self._tactile[name]]
        return Group(table, *(Text(printable.shown(footer_line)) for footer_line in self._footer()), *maps)

    def _heat_map(self, name: str) -> list[Any]:
        """Return the heat map of a stream as (text, style) pairs and line breaks; an empty list without a rest level.

        Colours show the distance of each tactile channel from its rest level, relative to the largest so far.
        """
        watch, positions = self._watches[name], self._tactile[name]
        if watch.newest is None or watch.rest_level is None:
            return []
        distance = np.abs(watch.newest[positions] - watch.rest_level[positions])
        self._largest[name] = max(self._largest[name], float(distance.max()))
        shade = np.minimum(distance / self._largest[name] * len(SHADES), len(SHADES) - 1).astype(int)
        cells: list[Any] = []
        for number, level in enumerate(shade.tolist()):
            cells.append(("  ", f"on {SHADES[level]}"))
            if (number + 1) % MAX_COLUMNS == 0:
                cells.append("\n")
        return cells


def describe_figures(name: str, figures: Figures) -> str:
    """Return the figures of a stream as one line.

    >>> describe_figures("xela1", Figures(50.02, 0.41, None, 120, 1, 0, 0))
    'xela1 50.0 Hz, jitter 0.4 ms, 120 samples, 1 lost'
    """
    latency = "" if figures.latency_ms is None else f", latency {figures.latency_ms:.1f} ms"
    counts = f"{figures.samples} samples, {figures.lost} lost"
    counts += f", about {figures.lost_estimated} more" * (figures.lost_estimated > 0)
    return f"{name} {figures.rate_hz:.1f} Hz, jitter {figures.jitter_ms:.1f} ms{latency}, {counts}"
