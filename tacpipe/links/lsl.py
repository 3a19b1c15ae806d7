"""Streams of Lab Streaming Layer (LSL): what an outlet sends, a packet of samples an entry, as `tacpipe.sensors.lsl` reads.

Samples are given out as they come, with the stamps of the sender's clock; LSL moves none of them. What its own measurement
reports about that clock comes with them in each packet. An outlet that ends loses the link, which is then opened anew, as a
cable would be.
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
from tacpipe.links.opened import Arrived, Opened
from tacpipe.plugins import extras
from tacpipe.sensors import lsl
from tacpipe.sensors.sensor import Sensor

KEYS = ("name", "type", "source_id", "hostname", "uid")  # of a stream, that an address may name
RESOLVE_S = 3.0  # that outlets have to answer
OTHERS_S = 1.0  # that another outlet of the same name has
OPEN_S = 5.0  # that one outlet has to describe and open its stream
CORRECTION_S, CORRECTED_S = 2.0, 5.0  # that a measurement of the clock takes at most, and between two of them
CONFIGURED = (Path("lsl_api.cfg"), Path("~/lsl_api/lsl_api.cfg"), Path("/etc/lsl_api/lsl_api.cfg"))
SILENT = "[log]\nlevel = -3\n"
BUFFERED_S = 360  # that liblsl keeps what is not fetched, of streams with a rate
MOST = 4096  # samples of a packet


def open_lsl(place: str, sensor: Sensor, name: str) -> LslLink:
    """Return the open stream of ``NAME``, or of ``?type=Force&source_id=ft-7`` with any of the keys of `KEYS`.

    Raises `DeviceError` where no outlet or several are as the address states, or the stream has other channels than the
    rig file states; `MissingModuleError` without pylsl, `UsageError` for an address that is none.
    """
    wanted = _wanted(place)
    with extras.named(name):
        import pylsl
    quiet(pylsl)
    found = _resolved(pylsl, wanted)
    if len(found) != 1:
        raise DeviceError(f"{name}: {_other(pylsl, found)}")
    inlet = pylsl.StreamInlet(found[0], max_buflen=BUFFERED_S, recover=False)
    try:
        text = inlet.info(OPEN_S).as_xml()
        inlet.open_stream(OPEN_S)
    except (pylsl.util.LostError, pylsl.util.TimeoutError, TimeoutError, RuntimeError) as error:
        raise DeviceError(
            f"{name}: the outlet was found, and does not open within {OPEN_S:g} s; check that its program still runs, and "
            "that no firewall keeps its ports (TCP and UDP 16572 to 16604) from this computer."
        ) from error
    return LslLink(name, inlet, _checked(text, sensor, name), pylsl)


def quiet(pylsl: Any) -> None:
    """Keep liblsl's messages off the terminal, unless a file of the user's configures it."""
    if not os.environ.get("LSLAPICFG") and not any(path.expanduser().is_file() for path in CONFIGURED):
        pylsl.util.set_config_content(SILENT)  # does nothing where LSL was used before in this process


def _wanted(place: str) -> Mapping[str, str]:
    """Return what a stream must state, by key.

    >>> _wanted("wrist"), _wanted("?type=Force&source_id=ft-7")
    ({'name': 'wrist'}, {'type': 'Force', 'source_id': 'ft-7'})
    """
    name, _, query = place.partition("?")
    pairs = parse_qsl(query, keep_blank_values=True)
    found = {**({"name": name} if name else {}), **dict(pairs)}
    if not found or any(key not in KEYS or not value or "'" in value or '"' in value for key, value in found.items()):
        raise UsageError(
            f"lsl:{place} names no stream; it should read lsl:NAME or lsl:?type=Force&source_id=ft-7, with the keys "
            f"{', '.join(KEYS)} and no quotes."
        )
    return found


def _resolved(pylsl: Any, wanted: Mapping[str, str]) -> list[Any]:
    """Return the streams that are so; when one has answered, others have until liblsl has asked a second time."""
    predicate = " and ".join(f"{key}='{value}'" for key, value in wanted.items())
    first: list[Any] = pylsl.resolve_bypred(predicate, 1, RESOLVE_S)
    return first if len(first) != 1 else pylsl.resolve_bypred(predicate, 2, OTHERS_S) or first


def _other(pylsl: Any, found: list[Any]) -> str:
    if found:
        uids = ", ".join(sorted(f"source_id={one.source_id()} on {one.hostname()}" for one in found))
        return f"{len(found)} outlets are as the address states: {uids}. Add source_id or hostname to it."
    others = sorted({f"{one.name()} (type {one.type()})" for one in pylsl.resolve_streams(OTHERS_S)})
    there = f"there are {', '.join(others)}" if others else "there is none at all"
    return (
        f"no outlet answered within {RESOLVE_S:g} s; {there}. Start the program that sends the stream, or name its computer "
        "in KnownPeers of lsl_api.cfg where the network does not carry multicast."
    )


def _checked(text: str, sensor: Sensor, name: str) -> str:
    """Return the description of a stream. Raises `DeviceError` where it is not what the rig file states."""
    try:
        found = descriptions.parse(text)
    except TacpipeError as error:
        raise DeviceError(f"{name}: the stream cannot be read: {error}.") from error
    if not isinstance(sensor, lsl.Lsl) or sensor.incomplete:
        return text
    if (found.format, len(found.channels)) != (sensor.format, len(sensor.channels)):
        raise DeviceError(
            f"{name}: the stream has {len(found.channels)} channels of {found.format}, and the rig file states "
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
        self._ended = threading.Event()
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
        found = [(time.monotonic_ns(), self._packet(values, stamps))] if len(stamps) else []
        with contextlib.suppress(
            self._pylsl.util.LostError
        ):  # which the next read states: what came first is given out
            values, stamps = self.inlet.pull_chunk(0.0, MOST, as_numpy=True) if found else ((), ())
            found += [(time.monotonic_ns(), self._packet(values, stamps))] if len(stamps) else []
        return found

    def _packet(self, values: Any, stamps: Any) -> bytes:
        rows = np.asarray(values)
        if rows.dtype.kind == "O":
            flat = [word.decode(errors="replace") if isinstance(word, bytes) else str(word) for word in rows.ravel()]
            rows = np.array(flat, dtype=object)
        rows = rows.reshape(len(stamps), -1)
        return lsl.packet(rows, np.asarray(stamps, dtype=np.float64), self._correction)

    def _measure(self) -> None:
        """Have LSL measure the sender's clock now and then: it takes a second, and a reader must not wait for it."""
        while not self._ended.is_set():
            with contextlib.suppress(Exception):  # no answer yet, or an outlet that is gone, which the reader states
                self._correction = float(self.inlet.time_correction(CORRECTION_S))
            self._ended.wait(CORRECTED_S)

    def _wake(self) -> None:
        self._ended.set()

    def _release(self) -> None:
        self._measuring.join(2 * CORRECTION_S)
        with contextlib.suppress(Exception):
            self.inlet.close_stream()
