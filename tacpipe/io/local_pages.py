"""Answer requests for pages from browsers on this computer only."""

from __future__ import annotations

from http.server import BaseHTTPRequestHandler

HOST = "127.0.0.1"
_HOSTS = (HOST, "localhost")


class LocalHandler(BaseHTTPRequestHandler):
    """Refuses requests under other host names, because a page of another site could read answers through its own name."""

    def do_GET(self) -> None:
        """Call `answer` if the request names this computer."""
        if self.headers.get("Host", "").rpartition(":")[0] in _HOSTS:
            self.answer()
        else:
            self.send_error(403)

    def answer(self) -> None:
        """Answer a request for ``path``."""
        raise NotImplementedError

    def log_message(self, *_: object) -> None:
        """Print nothing."""
