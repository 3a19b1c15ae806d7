"""Messages as a stream of LSL: one channel for each predicted channel and step, and one for the state of each alarm."""

from __future__ import annotations

import numpy as np

from tacpipe.live.alarms import NAMES
from tacpipe.live.messages import Description, Message
from tacpipe.plugins import extras


class LslPublisher:
    """An outlet; LSL keeps what its readers have not fetched and drops the oldest, so nobody is waited for."""

    def __init__(self, place: str, about: Description) -> None:
        with extras.named("--publish lsl"):
            import pylsl

        names = [f"{channel}_t{step}" for step in about.steps for channel in about.channels]
        info = pylsl.StreamInfo(
            place, "Forecast", len(names) + len(NAMES), about.rate_hz, pylsl.cf_float32, f"tacpipe-{place}"
        )
        channels = info.desc().append_child("channels")
        for name in (*names, *(f"{alarm}_state" for alarm in NAMES)):
            channel = channels.append_child("channel")
            channel.append_child_value("label", name)
            channel.append_child_value("unit", about.unit if name in names else "1")
        self.dropped = 0
        self._width = len(names)
        self._outlet = pylsl.StreamOutlet(info, max_buffered=2)

    def publish(self, message: Message) -> None:
        """Push a message; where there is no forecast its values are NaN."""
        values = np.full(self._width, np.nan, np.float32) if message.values is None else message.values.ravel()
        states = [message.alarms[name].state for name in NAMES]
        self._outlet.push_sample(np.concatenate([values, np.array(states, np.float32)]).astype(np.float32))

    def close(self) -> None:
        """Take the outlet away."""
        del self._outlet
