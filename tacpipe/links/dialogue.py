"""Carrying out what a sensor states to its device, and waiting for the replies."""

from __future__ import annotations

import time

from tacpipe.errors import DeviceError
from tacpipe.links.link import Link
from tacpipe.links.opened import Arrived
from tacpipe.sensors.sensor import Ask, Dialogue

SHOWN = 16  # bytes of what came instead of a reply


class NoReplyError(DeviceError):
    """No reply came in time: ``awaited`` states which and for how long, ``heard`` holds what came instead."""

    def __init__(self, ask: Ask, heard: Arrived, stream: str) -> None:
        super().__init__(_silent(ask, heard, stream))
        self.awaited = f"{ask.what} was awaited for {ask.timeout_s:g} s"
        self.heard = heard


def hold(link: Link, dialogue: Dialogue, stream: str) -> Arrived:
    """Carry out a dialogue; return what came that was not a reply as (arrival, bytes), so that no sample is lost.

    What is behind a reply counts for the next question only if nothing is sent for it. Raises `NoReplyError` where no reply
    comes in time, and what a question raises for a reply that means no.
    """
    other: Arrived = []
    since: Arrived = []  # the last question
    control: Link = getattr(link, "control", link)
    try:
        ask = next(dialogue)
        while True:
            if ask.send:
                other, since = other + since, []
                control.write(ask.send)
            reply = b""
            if ask.until is not None:
                reply, before = _reply(control, ask, since, stream)
                other += before
            since += _pause(control, ask.pause_s)
            ask = dialogue.send(reply)
    except StopIteration:
        return sorted(other + since, key=lambda entry: entry[0])


def _reply(link: Link, ask: Ask, since: Arrived, stream: str) -> tuple[bytes, Arrived]:
    """Return the reply and what came before it, which is none; what is behind stays in ``since``."""
    until = time.monotonic() + ask.timeout_s
    seen, over = 0, False
    while True:
        found = _found(ask, since, seen, packets=bool(getattr(link, "packets", False)))
        if found is not None:
            return found
        if over:
            raise NoReplyError(ask, since, stream)
        seen = len(since)
        left_s = until - time.monotonic()
        over = left_s <= 0  # a last look: a process that was held up finds the reply waiting
        since += link.read(max(left_s, 0.0))


def _found(ask: Ask, since: Arrived, seen: int, *, packets: bool) -> tuple[bytes, Arrived] | None:
    """Return the reply as `_reply` does, taken out of ``since``: of packets one by itself, if that has it, else all."""
    for row in range(seen, len(since)) if packets else ():
        place = ask.found(since[row][1])
        if place is not None:
            return _taken(since, sum(len(data) for _, data in since[:row]), *place)
    place = ask.found(b"".join(data for _, data in since))
    return None if place is None else _taken(since, 0, *place)


def _taken(since: Arrived, base: int, start: int, stop: int) -> tuple[bytes, Arrived]:
    """Take bytes ``start`` to ``stop``, counted from ``base`` on, and those before out of ``since``; return both."""
    before = _cut(since, base + start)
    return b"".join(data for _, data in _cut(since, stop - start)), before


def _cut(since: Arrived, count: int) -> Arrived:
    """Cut the first ``count`` bytes off and return them, each with its arrival."""
    front: Arrived = []
    while count:
        t_ns, data = since.pop(0)
        front.append((t_ns, data[:count]))
        if len(data) > count:
            since.insert(0, (t_ns, data[count:]))
        count -= len(front[-1][1])
    return front


def _pause(link: Link, pause_s: float) -> Arrived:
    """Return what comes during a pause: read it, because queues are short."""
    until, came = time.monotonic() + pause_s, []
    while (left_s := until - time.monotonic()) > 0:
        came += link.read(left_s)
    return came


def _silent(ask: Ask, since: Arrived, stream: str) -> str:
    count = sum(len(data) for _, data in since)
    first = b"".join(data for _, data in since)[:SHOWN]
    instead = f"{count} bytes came that are none, the first {first.hex(' ')}" if count else "nothing came at all"
    return (
        f"Stream {stream}: {ask.what} was awaited for {ask.timeout_s:g} s, but {instead}. Check that the device is switched "
        f"on, and what it is with `tacpipe sensors probe`."
    )
