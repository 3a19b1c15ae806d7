"""The streams that a live session adds to the rig, for what the model's process publishes."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Sequence
from dataclasses import replace

from tacpipe.errors import UsageError
from tacpipe.links.link import Address
from tacpipe.live.description import Described, Grasped, Surfaces
from tacpipe.live.options import OWN
from tacpipe.recording import rig as rigs
from tacpipe.recording import rig_text
from tacpipe.recording.rig import Rig, Stream


def added(rig: Rig, about: Described | Surfaces | Grasped, steps: Sequence[int]) -> Rig:
    """Return a rig with the session's own streams, as ``forecast`` and ``latency``, at free ports of this computer.

    Raises `UsageError` where it has streams of these names, and for forecasts too large for a packet.
    """
    taken = [name for name in OWN if name in rig.streams]
    if taken:
        raise UsageError(f"The rig file has a stream {taken[0]}, as a live session adds itself; give it another name.")
    options = about.own(steps)
    own = {
        name: Stream(name, "live", rigs.make("live", found, "live"), Address("udp", f"127.0.0.1:{port}"), found)
        for (name, found), port in zip(options.items(), free_ports(len(options)), strict=True)
    }
    made = replace(rig, streams={**rig.streams, **own})
    return replace(made, text=rig_text.of(made))


def free_ports(count: int) -> list[int]:
    """Return UDP ports of this computer that nobody listens on."""
    with contextlib.ExitStack() as held:
        found = []
        for _ in range(count):
            one = held.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            one.bind(("127.0.0.1", 0))
            found.append(int(one.getsockname()[1]))
    return found
