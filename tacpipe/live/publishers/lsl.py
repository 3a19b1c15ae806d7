"""Messages as a stream of LSL: one channel for each of their columns; those of a forecast and the states of its alarms."""

from __future__ import annotations

import numpy as np

from tacpipe.links import lsl
from tacpipe.live.messages import About, Published
from tacpipe.plugins import extras


class LslPublisher:
    """An outlet; LSL keeps what its readers have not fetched and drops the oldest, so nobody is waited for."""

    def __init__(self, place: str, about: About) -> None:
        with extras.named("--publish lsl"):
            import pylsl
        lsl.quiet(pylsl)
        columns = about.columns()
        info = pylsl.StreamInfo(
            place, about.kind.capitalize(), len(columns), about.rate_hz, pylsl.cf_float32, f"tacpipe-{place}"
        )
        channels = info.desc().append_child("channels")
        for name, unit in columns:
            channel = channels.append_child("channel")
            channel.append_child_value("label", name)
            channel.append_child_value("unit", unit)
        self.dropped = 0
        self._width = len(columns)
        self._outlet = pylsl.StreamOutlet(info, max_buffered=2)

    def publish(self, message: Published) -> None:
        """Push a message; where there is no answer of the model, its numbers are NaN but for those known without."""
        columns = message.columns()
        self._outlet.push_sample(np.concatenate([np.full(self._width - len(columns), np.nan, np.float32), columns]))

    def close(self) -> None:
        """Take the outlet away."""
        del self._outlet
