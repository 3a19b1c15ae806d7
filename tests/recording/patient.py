"""A recorder that gives devices as long as a busy computer may take: it can be run in the place of ``tacpipe.cli``.

How long a device may be silent is tried over a clock that the test turns, in `test_schedule`. Where devices are emulated in
real time, these limits would measure the computer.
"""

from __future__ import annotations

import importlib
from dataclasses import replace

import pytest

from tacpipe.links import dialogue
from tacpipe.sensors.sensor import Ask

TIMES = 50
LIMITS = {
    "tacpipe.recording.recorder": ("FIRST_S", "SILENT_S"),
    "tacpipe.recording.station": ("MUTE_S", "TARE_S", "REPLY_S", "STOP_S"),
    "tacpipe.links.network": ("CONNECT_S",),
    "tacpipe.links.opened": ("WRITE_S",),
}


def relax(patch: pytest.MonkeyPatch) -> None:
    """Make the limits so many times as long until ``patch`` is undone."""
    for name, limits in LIMITS.items():
        module = importlib.import_module(name)
        for limit in limits:
            patch.setattr(module, limit, getattr(module, limit) * TIMES)
    reply = dialogue._reply
    patch.setattr(dialogue, "_reply", lambda link, ask, *more: reply(link, longer(ask), *more))


def longer(ask: Ask) -> Ask:
    """Return a question whose reply is awaited for so many times as long."""
    return replace(ask, timeout_s=ask.timeout_s * TIMES)


if __name__ == "__main__":
    from tacpipe import cli

    relax(pytest.MonkeyPatch())
    cli.main()
