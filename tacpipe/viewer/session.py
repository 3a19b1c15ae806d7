"""Write recordings for Rerun's viewer, one file each, and open the viewer in a window or a local browser.

Rerun's program serves the viewer and the recordings. Its page would load fonts and send statistics over the network;
the server here hands the page on with a policy under which a browser refuses that.
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
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from urllib.parse import quote

from tacpipe.errors import TacpipeError
from tacpipe.viewer.contents import DrawnContents

NAME = "tacpipe"
ENDING = ".rrd"
UNSAFE = r"[/\\:\x00]"  # characters that no file name may have


def write(
    recordings: Iterable[DrawnContents], folder: Path, dataset: str, *, with_list: bool = True, all_rows: bool = False
) -> list[Path]:
    """Write a file of Rerun's for each recording and return the files; the viewer lists them by name below ``dataset``.

    Lines of more than 30,000 rows are written as their envelope, unless ``all_rows``. ``with_list`` shows the list.
    """
    import rerun as rr

    from tacpipe.viewer import layout, stream

    looks: dict[str, str] = {}
    paths = []
    for contents in recordings:
        look = repr(layout.signature(contents))
        name = looks.setdefault(look, application(dataset, len(looks)))
        paths.append(folder / f"{re.sub(UNSAFE, '-', contents.name)}{ENDING}")
        recording = rr.RecordingStream(name, recording_id=contents.name)
        recording.save(paths[-1])
        recording.send_recording_name(contents.name)
        recording.send_blueprint(layout.blueprint(contents, with_list=with_list))
        stream.RerunStream(recording, contents.ends_ns[0], all_rows=all_rows).send(contents)
        recording.disconnect()  # writes what is left
    return paths


def program() -> str:
    """Return the path of Rerun's viewer, a program of its own within the package. Raises `MissingModuleError` without it."""
    import rerun_cli

    name = "rerun.exe" if sys.platform == "win32" else "rerun"
    bundled = Path(rerun_cli.__file__).parent / "Rerun.app" / "Contents" / "MacOS" / "Rerun"
    return str(bundled if bundled.exists() else Path(rerun_cli.__file__).parent / name)


def environment() -> dict[str, str]:
    """Return the environment of Rerun's programs: with ``CI`` set they neither collect nor send what they call analytics."""
    return {**os.environ, "CI": "true"}


def show(files: Sequence[Path]) -> int:
    """Open files in the viewer and return its exit code once it is closed."""
    return subprocess.run([program(), *files], env=environment(), stderr=subprocess.DEVNULL, check=False).returncode


def application(dataset: str, number: int) -> str:
    """Return the name under which the viewer groups recordings that share a layout; it allows few characters.

    >>> application("data/recordings", 0), application("data/recordings", 1)
    ('data-recordings', 'data-recordings-2')
    """
    name = re.sub(r"[^A-Za-z0-9]+", "-", dataset).strip("-") or NAME
    return name if not number else f"{name}-{number + 1}"


HOST, PORT = "127.0.0.1", 9090
POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob: data:; "
    "connect-src 'self' blob: data: http://localhost:* http://127.0.0.1:*"
)
PATIENCE_S = 60.0  # until the viewer's page is there


class _Handler(BaseHTTPRequestHandler):
    source = ""

    def do_GET(self) -> None:
        """Answer with what the viewer's own server gives, under the policy."""
        try:
            with urllib.request.urlopen(self.source + self.path, timeout=PATIENCE_S) as answer:
                content, kind = answer.read(), answer.headers.get("Content-Type", "application/octet-stream")
        except OSError:
            self.send_error(502)
            return
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Content-Security-Policy", POLICY)
        self.end_headers()
        with suppress(OSError):  # the browser has left
            self.wfile.write(content)

    def log_message(self, *_: object) -> None:
        """Print nothing."""


@contextmanager
def served(files: Sequence[Path], port: int | None) -> Iterator[str]:
    """Serve files in the web viewer while in the block, and yield the address to open; ``port`` None is 9090 or a free one.

    Raises `TacpipeError` if a port is taken or the viewer does not start.
    """
    data, assets = _free(), _free()
    ports = ["--bind", HOST, "--port", str(data), "--web-viewer-port", str(assets)]
    command = [program(), *map(str, files), "--serve-web", *ports]
    with subprocess.Popen(command, env=environment(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as viewer:
        try:
            source = f"http://{HOST}:{assets}"
            _wait(source, viewer)
            server = _server(port, source)
            Thread(target=server.serve_forever, daemon=True).start()
            try:
                url = quote(f"rerun+http://localhost:{data}/proxy", safe="")
                yield f"http://{HOST}:{server.server_address[1]}/?url={url}"
            finally:
                server.shutdown()
                server.server_close()
        finally:
            viewer.terminate()


def _server(port: int | None, source: str) -> ThreadingHTTPServer:
    handler = type("Handler", (_Handler,), {"source": source})
    try:
        return ThreadingHTTPServer((HOST, PORT if port is None else port), handler)
    except OSError as error:
        if port is None:
            return ThreadingHTTPServer((HOST, 0), handler)
        raise TacpipeError(f"Port {port} cannot be used ({error.strerror}); give another --port.") from error


def _wait(source: str, viewer: subprocess.Popen[bytes]) -> None:
    until_s = time.monotonic() + PATIENCE_S
    while viewer.poll() is None and time.monotonic() < until_s:
        with suppress(OSError), urllib.request.urlopen(source, timeout=PATIENCE_S):
            return
        time.sleep(0.05)
    raise TacpipeError("Rerun's web viewer did not start; `tacpipe view DATASET --save FILE.rrd` writes a file for it.")


def _free() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])
