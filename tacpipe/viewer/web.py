"""Rerun's viewer in a browser of this computer, on a page that connects to nothing else.

Rerun's program serves the viewer and the recordings. Its page would load fonts and send statistics over the network;
the server here hands the page on with a policy under which a browser refuses that.
"""

from __future__ import annotations

import socket
import subprocess
import time
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from urllib.parse import quote

from tacpipe.errors import TacpipeError
from tacpipe.viewer import session

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
    command = [session.program(), *map(str, files), "--serve-web", *ports]
    with subprocess.Popen(
        command, env=session.environment(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as one:
        try:
            source = f"http://{HOST}:{assets}"
            _wait(source, one)
            server = _server(port, source)
            Thread(target=server.serve_forever, daemon=True).start()
            try:
                url = quote(f"rerun+http://localhost:{data}/proxy", safe="")
                yield f"http://{HOST}:{server.server_address[1]}/?url={url}"
            finally:
                server.shutdown()
                server.server_close()
        finally:
            one.terminate()


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
    with socket.socket() as one:
        one.bind((HOST, 0))
        return int(one.getsockname()[1])
