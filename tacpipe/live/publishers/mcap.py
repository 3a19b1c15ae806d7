"""Messages into an MCAP file, as JSON that Foxglove plots: the topics ``/description`` and, of forecasts, ``/forecast``.

A thread of its own writes: a disk may take its time.
"""

from __future__ import annotations

import json
import queue
import threading
from pathlib import Path

from tacpipe.errors import UsageError
from tacpipe.live.messages import About, Published, to_json
from tacpipe.plugins import extras

QUEUED = 500  # messages that wait for the disk: 10 s at 50 Hz


class McapPublisher:
    """Writes a file that did not exist before."""

    def __init__(self, place: str, about: About) -> None:
        with extras.named("--publish mcap"):
            from mcap.writer import Writer

        path = Path(place)
        try:
            self._file = path.open("xb")
        except FileExistsError:
            raise UsageError(f"--publish mcap:{place}: the file exists already; give another name.") from None
        except OSError as error:
            raise UsageError(f"--publish mcap:{place}: {error.strerror}.") from error
        self.dropped = 0
        self._writer = Writer(self._file)
        self._writer.start(profile="", library="tacpipe")
        described = {"type": "object", "properties": about.schema()}
        schema = self._writer.register_schema(
            f"tacpipe.{about.kind.capitalize()}", "jsonschema", json.dumps(described).encode()
        )
        self._about_topic, self._topic = (
            self._writer.register_channel(f"/{name}", "json", schema) for name in ("description", about.kind)
        )
        self._about: bytes | None = to_json(about.to_dict())
        self._waiting: queue.Queue[tuple[int, Published] | None] = queue.Queue(QUEUED)
        self._thread = threading.Thread(target=self._write, daemon=True)
        self._thread.start()

    def publish(self, message: Published) -> None:
        """Have a message written, if the disk keeps up."""
        try:
            self._waiting.put_nowait((message.t_ns, message))
        except queue.Full:
            self.dropped += 1

    def close(self) -> None:
        """Write what waits, and end the file."""
        self._waiting.put(None)
        self._thread.join()
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()

    def _write(self) -> None:
        while (entry := self._waiting.get()) is not None:
            t_ns, message = entry
            if self._about is not None:
                self._writer.add_message(self._about_topic, t_ns, self._about, t_ns)
                self._about = None
            self._writer.add_message(self._topic, t_ns, to_json(message.to_dict()), t_ns)
