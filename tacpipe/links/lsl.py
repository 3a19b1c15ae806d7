"""Read streams of Lab Streaming Layer (LSL). Each entry is a packet of samples for `tacpipe.sensors.lsl`.

Samples have timestamps of the sender's clock. Each packet also contains LSL's measurement of that clock's offset. If an
outlet ends, the link is lost and reopened, as if a cable was unplugged.
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
from tacpipe.links.link import Arrived, OpenLink
from tacpipe.plugins import extras
from tacpipe.sensors import lsl
from tacpipe.sensors.sensor import Sensor

KEYS = ("name", "type", "source_id", "hostname", "uid")  # properties of a stream that an address may contain
RESOLVE_S = 3.0  # timeout for the first outlet to respond
OTHERS_S = 1.0  # timeout for a second matching outlet to respond
OPEN_S = 5.0  # timeout for an outlet to describe and open its stream
CORRECTION_S, CORRECTION_PAUSE_S = 2.0, 5.0  # timeout of a clock measurement, and pause between two
CONFIG_FILES = (Path("lsl_api.cfg"), Path("~/lsl_api/lsl_api.cfg"), Path("/etc/lsl_api/lsl_api.cfg"))
SILENT_CONFIG = "[log]\nlevel = -3\n"
BUFFERED_S = 360  # seconds of a stream that liblsl buffers
MAX_SAMPLES = 4096  # per packet


def open_lsl(target: str, sensor: Sensor, name: str) -> LslLink:
    """Open the stream ``NAME``, or the stream with the properties in ``?type=Force&source_id=ft-7`` (see `KEYS`).

    Raises `DeviceError` if no outlet or several match, or if the channels differ from the rig file, `MissingModuleError`
    without pylsl, and `UsageError` for an invalid address.
    """
    properties = _parse_query(target)
    with extras.explain_missing(name):
        import pylsl
    silence_logging(pylsl)
    outlets = _resolve(pylsl, properties)
    if len(outlets) != 1:
        raise DeviceError(f"{name}: {_no_single_outlet(pylsl, outlets)}")
    inlet = pylsl.StreamInlet(outlets[0], max_buflen=BUFFERED_S, recover=False)
    try:
        text = inlet.info(OPEN_S).as_xml()
        inlet.open_stream(OPEN_S)
    except (pylsl.util.LostError, pylsl.util.TimeoutError, TimeoutError, RuntimeError) as error:
        raise DeviceError(
            f"{name}: the outlet exists, but its stream did not open within {OPEN_S:g} s; check that its program still "
            "runs, and that no firewall blocks its ports (TCP and UDP 16572 to 16604)."
        ) from error
    return LslLink(name, inlet, _check_description(text, sensor, name), pylsl)


def silence_logging(pylsl: Any) -> None:
    """Turn off liblsl's messages on the terminal, unless a user's configuration file exists."""
    if not os.environ.get("LSLAPICFG") and not any(path.expanduser().is_file() for path in CONFIG_FILES):
        pylsl.util.set_config_content(SILENT_CONFIG)  # this has no effect if LSL was already used in this process


def _parse_query(target: str) -> Mapping[str, str]:
    """Return the properties that a matching stream must have.

    Raises `UsageError` for unknown keys, quotes or no property.

    >>> _parse_query("wrist"), _parse_query("?type=Force&source_id=ft-7")
    ({'name': 'wrist'}, {'type': 'Force', 'source_id': 'ft-7'})
    """
    name, _, query = target.partition("?")
    pairs = parse_qsl(query, keep_blank_values=True)
    properties = {**({"name": name} if name else {}), **dict(pairs)}
    if not properties or any(
        key not in KEYS or not value or "'" in value or '"' in value for key, value in properties.items()
    ):
        raise UsageError(
            f"lsl:{target} is not a valid LSL address; use lsl:NAME or lsl:?type=Force&source_id=ft-7, with the "
            f"keys {', '.join(KEYS)} and without quotes."
        )
    return properties


def _resolve(pylsl: Any, properties: Mapping[str, str]) -> list[Any]:
    """Return the streams with these properties. After the first response, others have `OTHERS_S` to respond."""
    predicate = " and ".join(f"{key}='{value}'" for key, value in properties.items())
    first: list[Any] = pylsl.resolve_bypred(predicate, 1, RESOLVE_S)
    return first if len(first) != 1 else pylsl.resolve_bypred(predicate, 2, OTHERS_S) or first


def _no_single_outlet(pylsl: Any, outlets: list[Any]) -> str:
    """Return the end of an error that explains why no single outlet matches."""
    if outlets:
        uids = ", ".join(sorted(f"source_id={outlet.source_id()} on {outlet.hostname()}" for outlet in outlets))
        return f"{len(outlets)} outlets match the address: {uids}. Add source_id or hostname to it."
    names = sorted({f"{stream.name()} (type {stream.type()})" for stream in pylsl.resolve_streams(OTHERS_S)})
    listing = f"there are {', '.join(names)}" if names else "there is none at all"
    return (
        f"no outlet responded within {RESOLVE_S:g} s; {listing}. Start the program that sends the stream. If the network "
        "does not carry multicast, add its computer to KnownPeers in lsl_api.cfg."
    )


def _check_description(text: str, sensor: Sensor, name: str) -> str:
    """Return the description of a stream, ``text``. Raises `DeviceError` if it is invalid or contradicts the rig file."""
    try:
        description = descriptions.parse(text)
    except TacpipeError as error:
        raise DeviceError(f"{name}: the stream cannot be read: {error}.") from error
    if not isinstance(sensor, lsl.Lsl) or sensor.incomplete:
        return text
    if (description.format, len(description.channels)) != (sensor.format, len(sensor.channels)):
        raise DeviceError(
            f"{name}: the stream has {len(description.channels)} channels of {description.format}, but the rig file "
            f"declares {len(sensor.channels)} of {sensor.format}; omit channels and format to use those of the outlet."
        )
    return text


class LslLink(OpenLink):
    """An open LSL stream."""

    packets = True

    def __init__(self, name: str, inlet: Any, description: str, pylsl: Any) -> None:
        """Wrap an open inlet with the XML ``description`` of its stream, and start to measure its clock."""
        super().__init__(name)
        self.inlet, self._pylsl = inlet, pylsl
        self._description: bytes | None = lsl.DESCRIPTION + description.encode()
        self._correction = math.nan
        self._stopping = threading.Event()
        self._clock_thread = threading.Thread(target=self._measure_clock, daemon=True)
        self._clock_thread.start()

    def _receive(self, timeout_s: float) -> Arrived:
        """Return the description once, then the samples that arrived. Raises `LinkLostError` if the outlet ended."""
        if self._description is not None:
            packet, self._description = self._description, None
            return [(time.monotonic_ns(), packet)]
        try:
            values, stamps = self.inlet.pull_chunk(timeout_s, 1, as_numpy=True)
        except self._pylsl.util.LostError as error:
            raise self.lost("its outlet ended", "that its program still runs") from error
        entries = [(time.monotonic_ns(), self._packet(values, stamps))] if len(stamps) else []
        with contextlib.suppress(
            self._pylsl.util.LostError
        ):  # the next read raises it; these samples are returned first
            values, stamps = self.inlet.pull_chunk(0.0, MAX_SAMPLES, as_numpy=True) if entries else ((), ())
            entries += [(time.monotonic_ns(), self._packet(values, stamps))] if len(stamps) else []
        return entries

    def _packet(self, values: Any, stamps: Any) -> bytes:
        """Return the packet of samples, texts as UTF-8, with their stamps and the offset of the clock."""
        rows = np.asarray(values)
        if rows.dtype.kind == "O":
            flat = [word.decode(errors="replace") if isinstance(word, bytes) else str(word) for word in rows.ravel()]
            rows = np.array(flat, dtype=object)
        rows = rows.reshape(len(stamps), -1)
        return lsl.pack_samples(rows, np.asarray(stamps, dtype=np.float64), self._correction)

    def _measure_clock(self) -> None:
        """Measure the sender's clock repeatedly. This runs in a thread, because each measurement takes a second."""
        while not self._stopping.is_set():
            with contextlib.suppress(Exception):  # no response yet, or the outlet is gone, which the reader reports
                self._correction = float(self.inlet.time_correction(CORRECTION_S))
            self._stopping.wait(CORRECTION_PAUSE_S)

    def _wake(self) -> None:
        self._stopping.set()

    def _release(self) -> None:
        self._clock_thread.join(2 * CORRECTION_S)
        with contextlib.suppress(Exception):
            self.inlet.close_stream()
