"""Serve the streams of a rig file: choose the end of each link and its address for hosts."""

from __future__ import annotations

from pathlib import Path

from tacpipe.errors import DeviceError
from tacpipe.recording.rig import Stream
from tacpipe.simulation.emulation.endpoint import Endpoint

PACKETS = ("udp", "tcp+udp", "ws", "hid", "can", "folder")  # links that keep frames apart


def endpoint(stream: Stream, folder: Path) -> Endpoint:
    """Return the device's end of a stream's link, served from now on; ``folder`` is for pseudo-terminals and files.

    Raises `DeviceError` for a link that cannot be emulated.
    """
    scheme = stream.address.scheme
    if scheme == "serial":
        from tacpipe.simulation.emulation.pty import Pty

        return Pty(stream.sensor, _device(folder, stream.name))
    if scheme == "udp":
        return _udp(stream)
    if scheme in ("tcp", "tcp+udp"):
        from tacpipe.simulation.emulation.tcp import Tcp, TcpUdp

        return TcpUdp(stream.sensor) if scheme == "tcp+udp" else Tcp(stream.sensor)
    if scheme == "ws":
        from tacpipe.simulation.emulation.websocket import Websocket

        return Websocket(stream.sensor)
    if scheme == "can":
        from tacpipe.simulation.emulation.can import Slcan, VirtualCan

        if stream.address.place.startswith("virtual:"):
            return VirtualCan(stream.sensor, stream.address.place.removeprefix("virtual:"))
        return Slcan(stream.sensor, _device(folder, stream.name))
    if scheme == "folder":
        from tacpipe.simulation.emulation.folder import Folder

        return Folder(stream.sensor, folder / "files" / stream.name)
    if scheme == "hid":
        from tacpipe.simulation.emulation.hid import Hid

        return Hid(stream.sensor, stream.address, folder / "hid")
    raise DeviceError(
        f"{stream.name}: {stream.address} cannot be emulated; clouds can be, by a folder: folder:{folder / 'files'}."
    )


def _udp(stream: Stream) -> Endpoint:
    from tacpipe.simulation.emulation.udp import HOST, Udp, free_port

    host, _, _ = stream.address.place.partition("?")[0].rpartition(":")
    if stream.sensor.listens or not host:
        return Udp(stream.sensor, (HOST if host else "", free_port()))
    return Udp(stream.sensor)


def _device(folder: Path, name: str) -> Path:
    devices = (folder / "dev").absolute()
    devices.mkdir(parents=True, exist_ok=True)
    return devices / name
