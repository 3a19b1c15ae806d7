"""Show recordings in Rerun's viewer, with a few large views and the others in tabs.

Rerun's program serves the viewer and the recordings. Its page would load fonts and send statistics over the network, so
the server in this module forwards the page with a content security policy that prevents it.

The left side has the time axes, one below the other and linked: touch, spans, streams. The right side has the taxels at
the cursor, all taxels over the full recording, and a view of space. Rerun is imported inside the functions.
"""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from http.server import ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any
from urllib.parse import quote

import numpy as np

from tacpipe.errors import TacpipeError
from tacpipe.io.local_pages import HOST, LocalHandler
from tacpipe.traces.taxels import Taxels
from tacpipe.viewer import stream
from tacpipe.viewer.contents import DrawnContents

NAME = "tacpipe"
SUFFIX = ".rrd"
UNSAFE = r"[/\\:\x00]"  # characters that are not allowed in file names


def write(
    recordings: Iterable[DrawnContents], folder: Path, dataset: str, *, with_list: bool = True, all_rows: bool = False
) -> list[Path]:
    """Write a Rerun file for each recording and return the paths; the viewer lists them by name below ``dataset``.

    Lines of more than 30,000 rows are written as their envelope, unless ``all_rows``. ``with_list`` opens the panel
    with the list. Raises `MissingModuleError` if Rerun is not installed.
    """
    import rerun as rr

    names_by_layout: dict[str, str] = {}
    paths = []
    for contents in recordings:
        layout = repr(signature(contents))
        name = names_by_layout.setdefault(layout, application(dataset, len(names_by_layout)))
        paths.append(folder / f"{re.sub(UNSAFE, '-', contents.name)}{SUFFIX}")
        recording = rr.RecordingStream(name, recording_id=contents.name)
        recording.save(paths[-1])
        recording.send_recording_name(contents.name)
        recording.send_blueprint(blueprint(contents, with_list=with_list))
        stream.RerunStream(recording, contents.ends_ns[0], all_rows=all_rows).send(contents)
        recording.disconnect()  # flushes the file
    return paths


def program() -> str:
    """Return the path of Rerun's viewer, a separate program in the package. Raises `MissingModuleError` if not installed."""
    import rerun_cli

    name = "rerun.exe" if sys.platform == "win32" else "rerun"
    bundled = Path(rerun_cli.__file__).parent / "Rerun.app" / "Contents" / "MacOS" / "Rerun"
    return str(bundled if bundled.exists() else Path(rerun_cli.__file__).parent / name)


def environment() -> dict[str, str]:
    """Return the environment of Rerun's programs; ``CI`` prevents them from collecting or sending analytics."""
    return {**os.environ, "CI": "true"}


def show(files: Sequence[Path]) -> int:
    """Open files in the viewer, wait until it is closed, and return its exit code."""
    return subprocess.run([program(), *files], env=environment(), stderr=subprocess.DEVNULL, check=False).returncode


def application(dataset: str, number: int) -> str:
    """Return the name by which the viewer groups recordings with the same layout, of allowed characters only."""
    name = re.sub(r"[^A-Za-z0-9]+", "-", dataset).strip("-") or NAME
    return name if not number else f"{name}-{number + 1}"


PORT = 9090
POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob: data:; "
    "connect-src 'self' blob: data: http://localhost:* http://127.0.0.1:*"
)
TIMEOUT_S = 60.0  # timeout for the viewer's page


class _Handler(LocalHandler):
    source = ""

    def answer(self) -> None:
        """Forward the response of the viewer's own server, with the policy."""
        try:
            with urllib.request.urlopen(self.source + self.path, timeout=TIMEOUT_S) as response:
                content, kind = response.read(), response.headers.get("Content-Type", "application/octet-stream")
        except OSError:
            self.send_error(502)
            return
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Content-Security-Policy", POLICY)
        self.end_headers()
        with suppress(OSError):  # the browser may have disconnected
            self.wfile.write(content)


@contextmanager
def serve(files: Sequence[Path], port: int | None) -> Iterator[str]:
    """Serve files in the web viewer during the block, and yield its address; a ``port`` of None is 9090 or a free port.

    Raises `TacpipeError` if the port is in use or the viewer does not start.
    """
    data_port, page_port = _free_port(), _free_port()
    ports = ["--bind", HOST, "--port", str(data_port), "--web-viewer-port", str(page_port)]
    command = [program(), *map(str, files), "--serve-web", *ports]
    with subprocess.Popen(command, env=environment(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as viewer:
        try:
            source = f"http://{HOST}:{page_port}"
            _wait_for_viewer(source, viewer)
            server = _start_server(port, source)
            Thread(target=server.serve_forever, daemon=True).start()
            try:
                url = quote(f"rerun+http://localhost:{data_port}/proxy", safe="")
                yield f"http://{HOST}:{server.server_address[1]}/?url={url}"
            finally:
                server.shutdown()
                server.server_close()
        finally:
            viewer.terminate()


def _start_server(port: int | None, source: str) -> ThreadingHTTPServer:
    """Return a server on the port, or on `PORT` or a free one for None, that forwards the viewer's page at ``source``.

    Raises `TacpipeError` if the given port cannot be used.
    """
    handler = type("Handler", (_Handler,), {"source": source})
    try:
        return ThreadingHTTPServer((HOST, PORT if port is None else port), handler)
    except OSError as error:
        if port is None:
            return ThreadingHTTPServer((HOST, 0), handler)
        raise TacpipeError(f"Port {port} cannot be used ({error.strerror}); give another --port.") from error


def _wait_for_viewer(source: str, viewer: subprocess.Popen[bytes]) -> None:
    """Wait until the viewer answers at the address ``source``.

    Raises `TacpipeError` if it ends or `TIMEOUT_S` have passed.
    """
    deadline_s = time.monotonic() + TIMEOUT_S
    while viewer.poll() is None and time.monotonic() < deadline_s:
        with suppress(OSError), urllib.request.urlopen(source, timeout=TIMEOUT_S):
            return
        time.sleep(0.05)
    raise TacpipeError("Rerun's web viewer did not start; `tacpipe view DATASET --save FILE.rrd` writes a file for it.")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


# relative height of the panel of spans (the panel of touch has 3): per lane, minimum, maximum
LANE_HEIGHT, MIN_HEIGHT, MAX_HEIGHT = 0.35, 1.1, 2.2
MAPS_A_ROW = 3
SHORT_S, LOOP_S = 20.0, 10.0  # a recording up to this length plays in full; duration that is played of a longer one


def signature(contents: DrawnContents) -> tuple[Any, ...]:
    """Return the properties that determine the layout; recordings with equal properties share it."""
    titles = (
        sorted(f"{curve.stream} {curve.title}" for curve in contents.curves),
        sorted(finger.name for finger in contents.taxels),
    )
    steps = sorted({(forecast.measured.name, forecast.step) for forecast in contents.forecasts})
    space = (sorted(path.name for path in contents.paths), sorted({cloud.stream for cloud in contents.clouds}))
    cameras = sorted(camera.stream for camera in contents.frames)
    prediction = (
        (contents.classification.key, len(contents.classification.leading_scores())) if contents.classification else ()
    )
    return (*titles, steps, *space, cameras, bool(contents.events), bool(contents.truth), prediction)


def blueprint(contents: DrawnContents, *, with_list: bool = False) -> Any:
    """Return the layout of a recording's views as a Rerun blueprint; ``with_list`` opens the list of recordings."""
    import rerun.blueprint as rrb

    left, right = _time_views(contents), _cursor_views(contents)
    if left:
        root = rrb.Horizontal(_stack(left), _stack([*right, _space_views(contents)]), column_shares=[1.7, 1])
    elif right:
        root = rrb.Horizontal(_space_views(contents)[0], _stack(right), column_shares=[1, 1.2])
    else:
        root = _space_views(contents)[0]
    recording_list = rrb.BlueprintPanel(state="expanded" if with_list else "collapsed")
    return rrb.Blueprint(root, _time_panel(contents), rrb.SelectionPanel(state="hidden"), recording_list)


def _time_panel(contents: DrawnContents) -> Any:
    """Return the time panel; for a long recording, it loops over the seconds around the maximum touch."""
    import rerun as rr
    import rerun.blueprint as rrb

    part_s = loop_s(contents)
    if part_s is None:
        return rrb.TimePanel(state="collapsed", timeline=stream.TIMELINE, play_state="playing", loop_mode="all")
    selection = rr.encodings.AbsoluteTimeRange(*(round(edge_s * 1e9) for edge_s in part_s))
    return rrb.TimePanel(
        state="collapsed",
        timeline=stream.TIMELINE,
        play_state="playing",
        loop_mode="selection",
        time_selection=selection,
    )


def loop_s(contents: DrawnContents) -> tuple[float, float] | None:
    """Return the part of a recording of more than 20 s that plays first, in seconds from its start; None for all."""
    touched = [finger for finger in contents.taxels if len(finger.t_ns) > 1]
    if contents.duration_s <= SHORT_S or not touched:
        return None
    strongest = max(touched, key=lambda finger: float(np.nanmax(finger.load, initial=0.0)))
    peak_s = (int(strongest.t_ns[int(np.nanargmax(strongest.load))]) - contents.ends_ns[0]) / 1e9
    start_s = min(max(peak_s - LOOP_S / 2, 0.0), contents.duration_s - LOOP_S)
    return start_s, start_s + LOOP_S


def _stack(parts: list[tuple[Any, float]]) -> Any:
    import rerun.blueprint as rrb

    views, shares = zip(*parts, strict=True)
    return rrb.Vertical(*views, row_shares=list(shares)) if len(views) > 1 else views[0]


def _time_views(contents: DrawnContents) -> list[tuple[Any, float]]:
    """Return the views with a time axis, and their heights relative to each other."""
    import rerun.blueprint as rrb

    views: list[tuple[Any, float]] = []
    unit = f" ({_unit(contents)})".replace(" ()", "")
    future_forecasts = [forecast for forecast in contents.forecasts if forecast.step]
    if future_forecasts:
        for name in dict.fromkeys(forecast.measured.name for forecast in future_forecasts):
            title = f"{name}: load measured and predicted{unit}"
            views.append((_plot(_origin(stream.FORECAST, name), title), 2.0))
        views.append((_plot(stream.ERROR, f"Mean absolute error of the forecasts{unit}"), 1.3))
    elif any(len(finger.t_ns) > 1 for finger in contents.taxels):
        views.append((_plot(stream.TOUCH, f"Touch: mean distance of the taxels from rest{unit}"), 3.0))
    lanes = {span.lane for span in contents.spans} | ({"gaps"} if contents.gaps else set())
    lanes |= {f"events {event.stream}" for event in contents.events}
    if lanes:
        view = rrb.StateTimelineView(origin=stream.SPANS, name="Contacts, labels, gaps", time_view=_linked_axis())
        views.append((view, min(max(MIN_HEIGHT, LANE_HEIGHT * (len(lanes) + 1)), MAX_HEIGHT)))
    tabs = _tabs(contents)
    if tabs:
        views.append((rrb.Tabs(*tabs, active_tab=0) if len(tabs) > 1 else tabs[0], 3.2))
    return views


def _tabs(contents: DrawnContents) -> list[Any]:
    """Return one tab per stream, one for each finger's taxels, and one for the ground truth."""
    import rerun.blueprint as rrb

    tabs = []
    for name in contents.streams_by_priority:
        views = [
            _plot(_origin(stream.SERIES, name, curve.title), curve.title)
            for curve in contents.curves
            if curve.stream == name
        ]
        tabs.append(rrb.Vertical(*views, name=name or "rows") if len(views) > 1 else views[0])
    for finger in contents.taxels:
        if len(finger.t_ns) > 1:
            titles = [
                stream.channels_title(finger, axis) for axis in (stream.AXES if finger.change.shape[2] == 3 else ("",))
            ]
            views = [_plot(_origin(stream.CHANNELS, finger.name, title), title) for title in titles]
            tabs.append(rrb.Vertical(*views, name=f"{finger.name} taxels"))
    if contents.truth:
        views = [_plot(_origin(stream.TRUTH, curve.title), curve.title) for curve in contents.truth]
        tabs.append(rrb.Grid(*views, name="ground truth"))
    if contents.events:
        tabs.append(rrb.TextLogView(origin=stream.EVENTS, name="events"))
    return tabs


def _space_view(contents: DrawnContents) -> Any:
    """Return the view of paths and clouds, with a camera position from which all are visible."""
    import rerun.blueprint as rrb

    positions = [path.position_m for path in contents.paths] + [cloud.points_m for cloud in contents.clouds]
    if contents.clouds:  # the camera that recorded the cloud looks along z
        middle = np.median(np.concatenate([cloud.points_m for cloud in contents.clouds]), axis=0)
        eye_direction, up = np.array([0.0, 0.0, -1.0]), (0, -1, 0)
        extent = np.concatenate([cloud.points_m for cloud in contents.clouds])
    else:
        extent = np.concatenate(positions)
        middle, eye_direction, up = (extent.min(axis=0) + extent.max(axis=0)) / 2, np.array([0.8, -1.0, 0.6]), (0, 0, 1)
    low, high = np.quantile(extent, [0.02, 0.98], axis=0)
    reach_m = max(float(np.linalg.norm(high - low)), 0.05)
    eye = rrb.EyeControls3D(
        position=middle + eye_direction / np.linalg.norm(eye_direction) * reach_m, look_target=middle, eye_up=up
    )
    return rrb.Spatial3DView(origin=stream.SPACE, name="Space (m)", eye_controls=eye)


def _carpet_view(contents: DrawnContents) -> Any:
    """Return the view of all taxels over the recording, see `stream.RerunStream`."""
    import rerun.blueprint as rrb

    width, height = stream.carpet_size(contents)
    bounds = rrb.VisualBounds2D(x_range=(-10, width + 10), y_range=(-5, height + 5))
    return rrb.Spatial2DView(origin=stream.CARPET, name="All taxels over the recording", visual_bounds=bounds)


def _cursor_views(contents: DrawnContents) -> list[tuple[Any, float]]:
    """Return the views of the moment at the cursor, and their heights relative to each other."""
    import rerun.blueprint as rrb

    views: list[tuple[Any, float]] = []
    maps = [_map_view(name, finger, contents) for name, finger in _maps(contents)]
    if maps:
        grid = rrb.Grid(*maps, grid_columns=min(len(maps), MAPS_A_ROW)) if len(maps) > 1 else maps[0]
        views.append((grid, 3.0 if len(maps) <= MAPS_A_ROW else 4.0))
    if any(len(finger.t_ns) > 1 for finger in contents.taxels):
        views.append((_carpet_view(contents), 1.3))
    if contents.classification is not None:
        rows = len(contents.classification.leading_scores())
        bounds = rrb.VisualBounds2D(x_range=(-stream.NAMES_WIDTH, stream.BARS_WIDTH + 0.5), y_range=(-1.9, rows - 0.4))
        title = f"Predicted {contents.classification.key}, and the largest scores"
        views.append((rrb.Spatial2DView(origin=stream.NAMED, name=title, visual_bounds=bounds), 1.8))
    return views


def _space_views(contents: DrawnContents) -> tuple[Any, float]:
    """Return the tabs of space, cameras and the recording's labels as one view, and its relative height."""
    import rerun.blueprint as rrb

    views: list[Any] = [_space_view(contents)] if contents.paths or contents.clouds else []
    cameras = [
        rrb.Spatial2DView(origin=_origin(stream.CAMERAS, camera.stream), name=camera.stream)
        for camera in contents.frames
    ]
    tabs = [rrb.Horizontal(*cameras, name="Cameras")] if len(cameras) > 1 else cameras
    views = [*tabs, *views] if contents.markers else [*views, *tabs]  # the first tab is shown
    views.append(rrb.TextDocumentView(origin=stream.ABOUT, name="About"))
    return (rrb.Tabs(*views, active_tab=0) if len(views) > 1 else views[0]), 4.0 if contents.markers else 2.4


def _map_view(name: str, finger: Taxels, contents: DrawnContents) -> Any:
    """Return the view of a map of taxels, measured or predicted, with the map's title and bounds."""
    import rerun.blueprint as rrb

    x, y = stream.map_bounds(finger)
    bounds = rrb.VisualBounds2D(x_range=x, y_range=y)
    return rrb.Spatial2DView(
        origin=_origin(stream.MAPS, name), name=_map_title(name, finger, contents), visual_bounds=bounds
    )


def _maps(contents: DrawnContents) -> list[tuple[str, Taxels]]:
    """Return the maps of measured taxels and of predictions: the name of each, and the finger."""
    maps = []
    for finger in contents.taxels:
        maps.append((finger.name, finger))
        steps = [forecast.step for forecast in contents.forecasts if forecast.measured.name == finger.name]
        maps += [(stream.map_name(finger.name, compared, max(steps)), finger) for compared in stream.COMPARED if steps]
    return maps


def _unit(contents: DrawnContents) -> str:
    """Return the unit of the taxels, or empty if they have several."""
    units = {finger.unit for finger in contents.taxels}
    return units.pop() if len(units) == 1 else ""


def _map_title(name: str, finger: Taxels, contents: DrawnContents) -> str:
    """Return the title of a map, short enough for three in a row."""
    steps = [forecast.step for forecast in contents.forecasts if forecast.measured.name == finger.name]
    if not steps or name == finger.name:
        return name if contents.forecasts else f"{name} ({finger.unit})".replace(" ()", "")
    predicted = f"t+{max(steps)}" if max(steps) else "predicted"
    return predicted if name == stream.map_name(finger.name, stream.COMPARED[0], max(steps)) else f"error {predicted}"


def _plot(origin: str, name: str) -> Any:
    import rerun.blueprint as rrb

    return rrb.TimeSeriesView(origin=origin, name=name, axis_x=_linked_axis(), plot_legend=rrb.PlotLegend("RightTop"))


def _linked_axis() -> Any:
    import rerun.blueprint as rrb

    return rrb.TimeAxis(link="LinkToGlobal")


def _origin(*parts: str) -> str:
    import rerun

    return str(rerun.new_entity_path(list(parts)))
