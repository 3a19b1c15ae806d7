"""Control headless Chromium over a pipe with the DevTools protocol, to inspect a rendered page."""

import base64
import json
import os
import select
import shutil
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

PROGRAM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--remote-debugging-pipe",
)
LIMIT_S = 300.0  # far longer than any page takes: only a browser that hangs meets it


class Browser:
    """A running Chromium with one page."""

    def __init__(self, commands: int, answers: int, folder: Path) -> None:
        self._commands = os.fdopen(commands, "wb", buffering=0)
        self._answers = os.fdopen(answers, "rb", buffering=0)
        self._folder, self._number, self._unread = folder, 0, b""
        target = self._call("Target.createTarget", {"url": "about:blank"})["targetId"]
        attached = self._call("Target.attachToTarget", {"targetId": target, "flatten": True})
        self._session: str | None = attached["sessionId"]
        self._call("Page.enable")

    _session: str | None = None

    def show(self, page: bytes, width: int) -> None:
        """Show a page in a window of so many CSS pixels, and wait until it is loaded, its fonts are there and the charts
        in view are drawn.
        """
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        self._call("Emulation.setDeviceMetricsOverride", size)
        file = self._folder / f"page-{self._number}.html"
        file.write_bytes(page)
        self._call("Page.navigate", {"url": file.as_uri()})
        self._wait(lambda message: message.get("method") == "Page.loadEventFired")
        self.run("document.fonts.ready.then(() => true)")
        self.run("(window.drawn ? window.drawn() : Promise.resolve()).then(() => true)")

    def visit(self, address: str) -> None:
        """Open the page at an address, and wait until it is loaded."""
        self._call("Page.navigate", {"url": address})
        self._wait(lambda message: message.get("method") == "Page.loadEventFired")

    def dark(self, is_dark: bool) -> None:
        """Show pages as those who prefer dark ones see them."""
        feature = {"name": "prefers-color-scheme", "value": "dark" if is_dark else "light"}
        self._call("Emulation.setEmulatedMedia", {"features": [feature]})

    def media(self, name: str) -> None:
        """Show pages as on another medium, such as ``print``; empty: on the screen."""
        self._call("Emulation.setEmulatedMedia", {"media": name})

    def run(self, script: str) -> Any:
        """Return the value of a JavaScript expression, a promise's once it is kept."""
        request = {"expression": script, "awaitPromise": True, "returnByValue": True}
        answer = self._call("Runtime.evaluate", request)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def picture(self) -> bytes:
        """Return the whole page as a PNG."""
        shot = self._call("Page.captureScreenshot", {"format": "png", "captureBeyondViewport": True})
        return base64.b64decode(shot["data"])

    def close(self) -> None:
        """Ask the browser to end."""
        self._session = None
        self._call("Browser.close")
        self._commands.close()
        self._answers.close()

    def _call(self, method: str, params: Mapping[str, Any] | None = None) -> dict[str, Any]:
        self._number += 1
        number = self._number
        message: dict[str, Any] = {"id": number, "method": method, "params": params or {}}
        if self._session:
            message["sessionId"] = self._session
        self._commands.write(json.dumps(message).encode() + b"\0")
        answer = self._wait(lambda message: message.get("id") == number)
        assert "error" not in answer, (method, answer["error"])
        result: dict[str, Any] = answer["result"]
        return result

    def _wait(self, is_answer: Any) -> dict[str, Any]:
        """Return the next message that is wanted; others are events that nobody asked for."""
        while True:
            while b"\0" not in self._unread:
                ready, _, _ = select.select([self._answers], [], [], LIMIT_S)
                assert ready, f"Chromium hangs: it has not answered for {LIMIT_S:g} s"
                received = self._answers.read(1 << 16)
                if not received:
                    raise AssertionError("Chromium ended before it answered")
                self._unread += received
            first, _, self._unread = self._unread.partition(b"\0")
            message: dict[str, Any] = json.loads(first)
            if is_answer(message):
                return message


@contextmanager
def browser(folder: Path) -> Iterator[Browser]:
    """Start Chromium with an empty profile in ``folder``, and end it; one that does not answer for `LIMIT_S` is killed."""
    assert PROGRAM is not None
    commands, answers = os.pipe(), os.pipe()
    # Chromium reads commands from file 3 and writes to file 4; the shell puts them there before it becomes Chromium
    started = f'exec 3<&{commands[0]} 4>&{answers[1]}; exec "$0" "$@"'
    call = [PROGRAM, *FLAGS, f"--user-data-dir={folder / 'profile'}", "about:blank"]
    with (folder / "chromium.log").open("wb") as log:
        process = subprocess.Popen(
            ["bash", "-c", started, *call], pass_fds=(commands[0], answers[1]), stdout=log, stderr=log
        )
    for end in (commands[0], answers[1]):
        os.close(end)
    try:
        opened = Browser(commands[1], answers[0], folder)
        yield opened
        opened.close()
        process.wait(timeout=LIMIT_S)
    finally:
        process.kill()
        process.wait()
