"""Open the link at an address, send a sensor's requests to its device, and wait for the replies."""

from __future__ import annotations

import time
from collections.abc import Callable

from tacpipe.errors import DeviceError
from tacpipe.io.credentials import refuse_credentials
from tacpipe.links import camera, can, folder, hid, lsl, mjpeg, network, ports, v4l2, websocket
from tacpipe.links.link import Address, Arrived, Link
from tacpipe.sensors.sensor import Ask, Dialogue, Sensor

OPENERS: dict[str, Callable[[str, Sensor, str], Link]] = {
    "serial": ports.open_serial,
    "hid": hid.open_hid,
    "udp": network.open_udp,
    "tcp": network.open_tcp,
    "tcp+udp": network.open_tcp_udp,
    "ws": websocket.open_websocket,
    "can": can.open_can,
    "folder": folder.open_folder,
    "camera": camera.open_camera,
    "lsl": lsl.open_lsl,
    "mjpeg": mjpeg.open_mjpeg,
    "v4l2": v4l2.open_v4l2,
}


def open_link(address: Address, sensor: Sensor, stream: str) -> Link:
    """Open a link to a sensor. ``stream`` is its name in errors. Nothing is sent to the device; see `run_dialogue`.

    Raises `DeviceError` if the device is missing, busy, not permitted, or refuses the connection, and `UsageError` for an
    address with credentials.
    """
    refuse_credentials(str(address), f"Stream {stream}")
    if address.scheme in HOST_SCHEMES:
        refuse_credentials(f"//{address.target}", f"Stream {stream}")
    return OPENERS[address.scheme](address.target, sensor, f"Stream {stream} ({address})")


HOST_SCHEMES = ("udp", "tcp", "tcp+udp", "ws")  # links whose target begins with a host
QUOTED = 16  # maximum number of bytes that an error quotes


class NoReplyError(DeviceError):
    """No reply arrived in time.

    ``awaited`` describes the reply and the timeout; ``heard`` has the bytes that were received instead.
    """

    def __init__(self, ask: Ask, heard: Arrived, stream: str) -> None:
        super().__init__(_no_reply_text(ask, heard, stream))
        self.awaited = f"{ask.what} was awaited for {ask.timeout_s:g} s"
        self.heard = heard


def run_dialogue(link: Link, dialogue: Dialogue, stream: str) -> Arrived:
    """Run a dialogue and return all other bytes as (arrival in ns, bytes), so that no sample is lost.

    Bytes after a reply are searched for the next reply only if the next request sends nothing. Raises `NoReplyError` if a
    reply does not arrive in time, and the dialogue's own error if a reply is a refusal.
    """
    skipped: Arrived = []
    received: Arrived = []  # entries since the last request
    control: Link = getattr(link, "control", link)
    try:
        ask = next(dialogue)
        while True:
            if ask.send:
                skipped, received = skipped + received, []
                control.write(ask.send)
            reply = b""
            if ask.until is not None:
                reply, before = _wait_for_reply(control, ask, received, stream)
                skipped += before
            received += _pause(control, ask.pause_s)
            ask = dialogue.send(reply)
    except StopIteration:
        return sorted(skipped + received, key=lambda entry: entry[0])


def _wait_for_reply(link: Link, ask: Ask, received: Arrived, stream: str) -> tuple[bytes, Arrived]:
    """Return the reply and the entries before it. Later entries stay in ``received``. Raises `NoReplyError` on timeout."""
    deadline = time.monotonic() + ask.timeout_s
    searched, timed_out = 0, False
    while True:
        reply_and_before = _find_reply(ask, received, searched, packets=bool(getattr(link, "packets", False)))
        if reply_and_before is not None:
            return reply_and_before
        if timed_out:
            raise NoReplyError(ask, received, stream)
        searched = len(received)
        left_s = deadline - time.monotonic()
        timed_out = left_s <= 0  # read once more: if this process was delayed, the reply may be queued
        received += link.read(max(left_s, 0.0))


def _find_reply(ask: Ask, received: Arrived, searched: int, *, packets: bool) -> tuple[bytes, Arrived] | None:
    """Remove the reply from ``received`` and return it, with the entries before it. Returns None if there is none.

    If ``packets``, the packets from row ``searched`` on are searched individually first, then all bytes.
    """
    for row in range(searched, len(received)) if packets else ():
        span = ask.find_reply(received[row][1])
        if span is not None:
            return _remove_reply(received, sum(len(data) for _, data in received[:row]), *span)
    span = ask.find_reply(b"".join(data for _, data in received))
    return None if span is None else _remove_reply(received, 0, *span)


def _remove_reply(received: Arrived, base: int, start: int, stop: int) -> tuple[bytes, Arrived]:
    """Remove bytes ``start`` to ``stop``, relative to ``base``, and all earlier bytes from ``received``; return both."""
    before = _pop_bytes(received, base + start)
    return b"".join(data for _, data in _pop_bytes(received, stop - start)), before


def _pop_bytes(received: Arrived, count: int) -> Arrived:
    """Remove the first ``count`` bytes from ``received`` and return them with their arrival times."""
    removed: Arrived = []
    while count:
        t_ns, data = received.pop(0)
        removed.append((t_ns, data[:count]))
        if len(data) > count:
            received.insert(0, (t_ns, data[count:]))
        count -= len(removed[-1][1])
    return removed


def _pause(link: Link, pause_s: float) -> Arrived:
    """Read during a pause, because queues are short, and return the entries."""
    deadline, entries = time.monotonic() + pause_s, []
    while (left_s := deadline - time.monotonic()) > 0:
        entries += link.read(left_s)
    return entries


def _no_reply_text(ask: Ask, received: Arrived, stream: str) -> str:
    """Return the error for a reply that did not arrive: what was awaited, and what was received instead."""
    count = sum(len(data) for _, data in received)
    first = b"".join(data for _, data in received)[:QUOTED]
    instead = f"{count} other bytes were received, starting with {first.hex(' ')}" if count else "nothing was received"
    return (
        f"Stream {stream}: {ask.what} was awaited for {ask.timeout_s:g} s, but {instead}. Check that the device is switched "
        f"on, and identify it with `tacpipe sensors probe`."
    )
