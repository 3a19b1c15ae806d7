"""Open the link that an address names, send a sensor's requests to its device and wait for the replies."""

from __future__ import annotations

import time
from collections.abc import Callable

from tacpipe.errors import DeviceError
from tacpipe.links import camera, can, folder, hid, lsl, mjpeg, network, ports, v4l2, websocket
from tacpipe.links.link import Address, Arrived, Link
from tacpipe.sensors.sensor import Ask, Dialogue, Sensor

OPENERS: dict[str, Callable[[str, Sensor, str], Link]] = {
    "serial": ports.open_serial,
    "hid": hid.open_hid,
    "udp": network.open_udp,
    "tcp": network.open_tcp,
    "tcp+udp": network.open_both,
    "ws": websocket.open_websocket,
    "can": can.open_can,
    "folder": folder.open_folder,
    "camera": camera.open_camera,
    "lsl": lsl.open_lsl,
    "mjpeg": mjpeg.open_mjpeg,
    "v4l2": v4l2.open_v4l2,
}


def open_link(address: Address, sensor: Sensor, stream: str) -> Link:
    """Return an open link to a sensor. ``stream`` names it in errors. Nothing is sent to the device yet, see `dialogue`.

    Raises `DeviceError` where the device is missing, busy, not permitted, or refuses.
    """
    return OPENERS[address.scheme](address.place, sensor, f"Stream {stream} ({address})")


SHOWN = 16  # bytes that an error quotes where they are no reply


class NoReplyError(DeviceError):
    """No reply came in time. ``awaited`` states which and for how long; ``heard`` has the bytes that came instead."""

    def __init__(self, ask: Ask, heard: Arrived, stream: str) -> None:
        super().__init__(_no_reply_text(ask, heard, stream))
        self.awaited = f"{ask.what} was awaited for {ask.timeout_s:g} s"
        self.heard = heard


def run_dialogue(link: Link, dialogue: Dialogue, stream: str) -> Arrived:
    """Run a dialogue and return all bytes that were no reply as (arrival in ns, bytes), so that no sample is lost.

    Bytes after a reply count for the next question only if that question sends nothing. Raises `NoReplyError` where no
    reply comes in time, and the error of a question whose reply is a refusal.
    """
    skipped: Arrived = []
    since: Arrived = []  # entries since the last request
    control: Link = getattr(link, "control", link)
    try:
        ask = next(dialogue)
        while True:
            if ask.send:
                skipped, since = skipped + since, []
                control.write(ask.send)
            reply = b""
            if ask.until is not None:
                reply, before = _reply(control, ask, since, stream)
                skipped += before
            since += _pause(control, ask.pause_s)
            ask = dialogue.send(reply)
    except StopIteration:
        return sorted(skipped + since, key=lambda entry: entry[0])


def _reply(link: Link, ask: Ask, since: Arrived, stream: str) -> tuple[bytes, Arrived]:
    """Return the reply and the entries before it. Entries after the reply stay in ``since``."""
    until = time.monotonic() + ask.timeout_s
    searched, over = 0, False
    while True:
        match = _find_reply(ask, since, searched, packets=bool(getattr(link, "packets", False)))
        if match is not None:
            return match
        if over:
            raise NoReplyError(ask, since, stream)
        searched = len(since)
        left_s = until - time.monotonic()
        over = left_s <= 0  # one more read: the reply may be waiting after this process was delayed
        since += link.read(max(left_s, 0.0))


def _find_reply(ask: Ask, since: Arrived, searched: int, *, packets: bool) -> tuple[bytes, Arrived] | None:
    """Cut the reply out of ``since``: out of one packet where a packet has it, otherwise out of all bytes."""
    for row in range(searched, len(since)) if packets else ():
        place = ask.found(since[row][1])
        if place is not None:
            return _cut_reply(since, sum(len(data) for _, data in since[:row]), *place)
    place = ask.found(b"".join(data for _, data in since))
    return None if place is None else _cut_reply(since, 0, *place)


def _cut_reply(since: Arrived, base: int, start: int, stop: int) -> tuple[bytes, Arrived]:
    """Cut bytes ``start`` to ``stop``, counted from ``base``, and all earlier bytes out of ``since``; return both."""
    before = _cut(since, base + start)
    return b"".join(data for _, data in _cut(since, stop - start)), before


def _cut(since: Arrived, count: int) -> Arrived:
    """Cut the first ``count`` bytes off ``since`` and return them with their arrivals."""
    front: Arrived = []
    while count:
        t_ns, data = since.pop(0)
        front.append((t_ns, data[:count]))
        if len(data) > count:
            since.insert(0, (t_ns, data[count:]))
        count -= len(front[-1][1])
    return front


def _pause(link: Link, pause_s: float) -> Arrived:
    """Read during a pause, because queues are short, and return the entries."""
    until, entries = time.monotonic() + pause_s, []
    while (left_s := until - time.monotonic()) > 0:
        entries += link.read(left_s)
    return entries


def _no_reply_text(ask: Ask, since: Arrived, stream: str) -> str:
    count = sum(len(data) for _, data in since)
    first = b"".join(data for _, data in since)[:SHOWN]
    instead = f"{count} bytes came that are none, the first {first.hex(' ')}" if count else "nothing came at all"
    return (
        f"Stream {stream}: {ask.what} was awaited for {ask.timeout_s:g} s, but {instead}. Check that the device is switched "
        f"on, and what it is with `tacpipe sensors probe`."
    )
