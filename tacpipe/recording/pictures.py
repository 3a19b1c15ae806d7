"""Serve the newest frame of each camera to a browser on this computer while a rig runs.

The page shows each camera as a stream of JPEG images (multipart/x-mixed-replace). Frames are sent as they were recorded,
so nothing is decoded. A slow browser receives fewer frames and delays neither the recorder nor other browsers.
"""

from __future__ import annotations

import contextlib
import html
from collections.abc import Iterator, Mapping
from http.server import ThreadingHTTPServer
from threading import Event, Thread
from urllib.parse import quote, unquote

from tacpipe.errors import UsageError
from tacpipe.io import terminal
from tacpipe.io.local_pages import HOST, LocalHandler
from tacpipe.recording.watch import Watch
from tacpipe.video.images import START

POLL_S = 0.01  # period of looking for a new frame
IDLE_S = 0.2  # time without a new frame after which the last one is sent again, to detect that a browser disconnected
BOUNDARY = "tacpipe-frame"
STYLE = (
    "body{background:#111;color:#ddd;font:16px sans-serif}figure{display:inline-block}img{width:640px;max-width:95vw}"
)


@contextlib.contextmanager
def serve_pictures(watches: Mapping[str, Watch], port: int | None) -> Iterator[str]:
    """Serve the cameras among ``watches`` during the block, and yield the address of the page; "" if ``port`` is None.

    Raises `UsageError` if no stream is a camera, or if the port is not free.
    """
    if port is None:
        yield ""
        return
    cameras = {name: watch for name, watch in watches.items() if watch.stream.kind == "camera"}
    if not cameras:
        raise UsageError(f"--pictures {port} shows the cameras of a rig, and this rig has none. Leave it out.")
    stopping = Event()
    handler = type("Handler", (PictureHandler,), {"cameras": cameras, "stopping": stopping})
    try:
        server = ThreadingHTTPServer((HOST, port), handler)
    except OSError as error:
        raise UsageError(f"Port {port} cannot be used ({error.strerror}). Give another --pictures.") from error
    server.daemon_threads = True
    Thread(target=server.serve_forever, daemon=True).start()
    address = f"http://{HOST}:{server.server_address[1]}/"
    terminal.note(f"The cameras are shown at {address}")
    try:
        yield address
    finally:
        stopping.set()
        server.shutdown()
        server.server_close()


class PictureHandler(LocalHandler):
    """Answers requests for the page, and for the frames of a camera."""

    cameras: Mapping[str, Watch]
    stopping: Event

    def answer(self) -> None:
        """Send the page, or the frames of a camera until the browser disconnects."""
        name = unquote(self.path.lstrip("/"))
        if not name:
            self._send_page()
        elif name in self.cameras:
            self._send_frames(self.cameras[name])
        else:
            self.send_error(404)

    def _send_page(self) -> None:
        """Send a page with the images of all cameras."""
        figures = "".join(
            f'<figure><img src="/{quote(name)}" alt=""><figcaption>{html.escape(name)}</figcaption></figure>'
            for name in self.cameras
        )
        page = f"<!doctype html><title>tacpipe</title><style>{STYLE}</style>{figures}".encode()
        self.send_response(200)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.send_header("Content-Length", str(len(page)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(page)

    def _send_frames(self, watch: Watch) -> None:
        """Send the frames of a camera, and the last one again after `IDLE_S`, until the browser disconnects."""
        self.send_response(200)
        self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={BOUNDARY}")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        sent: bytes | None = None
        idle_s = 0.0
        with contextlib.suppress(OSError):  # the browser has disconnected
            while not self.stopping.is_set():
                frame = watch.newest_packet
                is_new = frame is not None and frame is not sent
                if frame is not None and frame.startswith(START) and (is_new or idle_s >= IDLE_S):
                    head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(frame)}\r\n\r\n"
                    self.wfile.write(head.encode() + frame + b"\r\n")
                    sent, idle_s = frame, 0.0
                self.stopping.wait(POLL_S)
                idle_s += POLL_S
