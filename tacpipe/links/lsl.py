"""Read streams of Lab Streaming Layer (LSL). Each entry is a packet of samples as `tacpipe.sensors.lsl` decodes it.

Samples keep the stamps of the sender's clock. Each packet also has LSL's own measurement of that clock. When an outlet ends,
the link is lost and opened again, like a cable that is unplugged.
"""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import numpy as np

from tacpipe.channels import lsl as descriptions
from tacpipe.errors import DeviceError, TacpipeError, UsageError
from tacpipe.links.link import Arrived, Opened
from tacpipe.plugins import extras
from tacpipe.sensors import lsl
from tacpipe.sensors.sensor import Sensor

KEYS = ("name", "type", "source_id", "hostname", "uid")  # properties of a stream that an address may state
RESOLVE_S = 3.0  # time that outlets have to answer
OTHERS_S = 1.0  # time that a second outlet of the same name has
OPEN_S = 5.0  # time that an outlet has to describe and open its stream
CORRECTION_S, CORRECTED_S = 2.0, 5.0  # limit of one measurement of the clock, and pause between two
CONFIGURED = (Path("lsl_api.cfg"), Path("~/lsl_api/lsl_api.cfg"), Path("/etc/lsl_api/lsl_api.cfg"))
SILENT = "[log]\nlevel = -3\n"
BUFFERED_S = 360  # liblsl buffers so many seconds of a stream with a rate
MOST = 4096  # samples per packet


def open_lsl(place: str, sensor: Sensor, name: str) -> LslLink:
    """Return the open stream of ``NAME``, or of ``?type=Force&source_id=ft-7`` with any of the keys of `KEYS`.

    Raises `DeviceError` where no outlet or several are as the address states, or the stream has other channels than the
    rig file states; `MissingModuleError` without pylsl, `UsageError` for an address that is none.
    """
    properties = _properties(place)
    with extras.explain_missing(name):
        import pylsl
    quiet(pylsl)
    outlets = _resolve(pylsl, properties)
    if len(outlets) != 1:
        raise DeviceError(f"{name}: {_no_single_outlet(pylsl, outlets)}")
    inlet = pylsl.StreamInlet(outlets[0], max_buflen=BUFFERED_S, recover=False)
    try:
        text = inlet.info(OPEN_S).as_xml()
        inlet.open_stream(OPEN_S)
    except (pylsl.util.LostError, pylsl.util.TimeoutError, TimeoutError, RuntimeError) as error:
        raise DeviceError(
            f"{name}: the outlet exists, but does not open within {OPEN_S:g} s; check that its program still runs, "
            "and that no firewall blocks its ports (TCP and UDP 16572 to 16604)."
        ) from error
    return LslLink(name, inlet, _checked(text, sensor, name), pylsl)


def quiet(pylsl: Any) -> None:
    """Keep liblsl's messages off the terminal, unless a file of the user's configures it."""
    if not os.environ.get("LSLAPICFG") and not any(path.expanduser().is_file() for path in CONFIGURED):
        pylsl.util.set_config_content(SILENT)  # does nothing where LSL was used before in this process


def _properties(place: str) -> Mapping[str, str]:
    """Return the properties that a stream must have.

    >>> _properties("wrist"), _properties("?type=Force&source_id=ft-7")
    ({'name': 'wrist'}, {'type': 'Force', 'source_id': 'ft-7'})
    """
    name, _, query = place.partition("?")
    pairs = parse_qsl(query, keep_blank_values=True)
    properties = {**({"name": name} if name else {}), **dict(pairs)}
    if not properties or any(
        key not in KEYS or not value or "'" in value or '"' in value for key, value in properties.items()
    ):
        raise UsageError(
            f"lsl:{place} names no stream; it should read lsl:NAME or lsl:?type=Force&source_id=ft-7, with the keys "
            f"{', '.join(KEYS)} and no quotes."
        )
    return properties


def _resolve(pylsl: Any, properties: Mapping[str, str]) -> list[Any]:
    """Return the streams with these properties. After a first answer, others have `OTHERS_S` to answer."""
    predicate = " and ".join(f"{key}='{value}'" for key, value in properties.items())
    first: list[Any] = pylsl.resolve_bypred(predicate, 1, RESOLVE_S)
    return first if len(first) != 1 else pylsl.resolve_bypred(predicate, 2, OTHERS_S) or first


def _no_single_outlet(pylsl: Any, outlets: list[Any]) -> str:
    """Return why no single outlet can be chosen, as the end of an error."""
    if outlets:
        uids = ", ".join(sorted(f"source_id={outlet.source_id()} on {outlet.hostname()}" for outlet in outlets))
        return f"{len(outlets)} outlets are as the address states: {uids}. Add source_id or hostname to it."
    names = sorted({f"{stream.name()} (type {stream.type()})" for stream in pylsl.resolve_streams(OTHERS_S)})
    listing = f"there are {', '.join(names)}" if names else "there is none at all"
    return (
        f"no outlet answered within {RESOLVE_S:g} s; {listing}. Start the program that sends the stream, or name its "
        "computer in KnownPeers of lsl_api.cfg where the network does not carry multicast."
    )


def _checked(text: str, sensor: Sensor, name: str) -> str:
    """Return the description of a stream. Raises `DeviceError` where it contradicts the rig file."""
    try:
        description = descriptions.parse(text)
    except TacpipeError as error:
        raise DeviceError(f"{name}: the stream cannot be read: {error}.") from error
    if not isinstance(sensor, lsl.Lsl) or sensor.incomplete:
        return text
    if (description.format, len(description.channels)) != (sensor.format, len(sensor.channels)):
        raise DeviceError(
            f"{name}: the stream has {len(description.channels)} channels of {description.format}, and the rig file states "
            f"{len(sensor.channels)} of {sensor.format}; leave channels and format out, and they are as the outlet states."
        )
    return text


class LslLink(Opened):
    """An open stream of LSL."""

    packets = True

    def __init__(self, name: str, inlet: Any, description: str, pylsl: Any) -> None:
        super().__init__(name)
        self.inlet, self._pylsl = inlet, pylsl
        self._first: bytes | None = lsl.DESCRIPTION + description.encode()
        self._correction = math.nan
        self._stopping = threading.Event()
        self._measuring = threading.Thread(target=self._measure, daemon=True)
        self._measuring.start()

    def _receive(self, timeout_s: float) -> Arrived:
        if self._first is not None:
            packet, self._first = self._first, None
            return [(time.monotonic_ns(), packet)]
        try:
            values, stamps = self.inlet.pull_chunk(timeout_s, 1, as_numpy=True)
        except self._pylsl.util.LostError as error:
            raise self.lost("its outlet ended", "that its program still runs") from error
        entries = [(time.monotonic_ns(), self._packet(values, stamps))] if len(stamps) else []
        with contextlib.suppress(self._pylsl.util.LostError):  # the next read raises it; these samples go out first
            values, stamps = self.inlet.pull_chunk(0.0, MOST, as_numpy=True) if entries else ((), ())
            entries += [(time.monotonic_ns(), self._packet(values, stamps))] if len(stamps) else []
        return entries

    def _packet(self, values: Any, stamps: Any) -> bytes:
        rows = np.asarray(values)
        if rows.dtype.kind == "O":
            flat = [word.decode(errors="replace") if isinstance(word, bytes) else str(word) for word in rows.ravel()]
            rows = np.array(flat, dtype=object)
        rows = rows.reshape(len(stamps), -1)
        return lsl.packet(rows, np.asarray(stamps, dtype=np.float64), self._correction)

    def _measure(self) -> None:
        """Measure the sender's clock again and again, in a thread because each measurement takes a second."""
        while not self._stopping.is_set():
            with contextlib.suppress(Exception):  # no answer yet, or an outlet that is gone, which the reader states
                self._correction = float(self.inlet.time_correction(CORRECTION_S))
            self._stopping.wait(CORRECTED_S)

    def _wake(self) -> None:
        self._stopping.set()

    def _release(self) -> None:
        self._measuring.join(2 * CORRECTION_S)
        with contextlib.suppress(Exception):
            self.inlet.close_stream()
