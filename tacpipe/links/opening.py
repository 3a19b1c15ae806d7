"""Open the link that an address names."""

from __future__ import annotations

from collections.abc import Callable

from tacpipe.links import camera, can, folder, hid, lsl, serial_port, tcp, udp, websocket
from tacpipe.links.link import Address, Link
from tacpipe.sensors.sensor import Sensor

OPENERS: dict[str, Callable[[str, Sensor, str], Link]] = {
    "serial": serial_port.open_serial,
    "hid": hid.open_hid,
    "udp": udp.open_udp,
    "tcp": tcp.open_tcp,
    "tcp+udp": tcp.open_both,
    "ws": websocket.open_websocket,
    "can": can.open_can,
    "folder": folder.open_folder,
    "camera": camera.open_camera,
    "lsl": lsl.open_lsl,
}


def open_link(address: Address, sensor: Sensor, stream: str) -> Link:
    """Return an open link to a sensor. ``stream`` names it in errors. Nothing is sent to the device yet, see `dialogue`.

    Raises `DeviceError` where the device is missing, busy, not permitted, or refuses.
    """
    return OPENERS[address.scheme](address.place, sensor, f"Stream {stream} ({address})")
