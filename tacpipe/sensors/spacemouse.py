"""3Dconnexion SpaceMouse on HID: deflection of its cap, and its buttons, one row per event.

Each report contains a part of the state: number 1 translation and rotation (six little-endian int16), or, with older
devices, number 1 translation and number 2 rotation; number 3 the buttons (one bit each); number 23 the battery of wireless
devices. A deflection is at most about 350.
Source: the reports from hidraw, which start with the number.

`StateFramer` stores the state and converts every report to a frame with the full state, so that `SpaceMouse.decode` needs no
memory. The initial state is 0: the cap at rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Bools, Bytes
from tacpipe.channels.schema import AXES
from tacpipe.errors import UsageError
from tacpipe.sensors.framing import MALFORMED, Account, Chunks, Framer, FrameRun, FramingLoss
from tacpipe.sensors.sensor import Frames, Samples, Sensor

TRANSLATION, ROTATION, BUTTONS, BATTERY = 1, 2, 3, 23
# size of a report in bytes, including its number
SIZES = {TRANSLATION: (13, 7), ROTATION: (7,), BUTTONS: tuple(range(2, 8)), BATTERY: (2, 3)}
PARTS = {TRANSLATION: slice(0, 6), ROTATION: slice(6, 12), BUTTONS: slice(12, 16)}  # bytes of each part in the state
FRAME = 17  # size of a state in bytes: number of the report, 6 axes, 32 buttons
MAX_REPORT = 13  # bytes


@dataclass(frozen=True)
class SpaceMouse(Sensor):
    """A SpaceMouse, for teleoperation."""

    summary: ClassVar[str] = "3Dconnexion SpaceMouse on HID: six axes and buttons, one row per event."
    links: ClassVar[tuple[str, ...]] = ("hid",)
    usb_ids: ClassVar[tuple[str, ...]] = ("256f:c635",)
    steady: ClassVar[bool] = False

    rate_hz: float = 125.0  # events per second while the cap is moved; there are none at rest
    split: bool = False  # True if rotation has its own report, as with older devices

    def __post_init__(self) -> None:
        if not 0 < self.rate_hz <= 1000:
            raise UsageError(f"spacemouse: rate_hz is {self.rate_hz:g}; it must be above 0 and at most 1000.")

    def fields(self) -> list[pa.Field]:
        """Return six axes, ``translation_x`` to ``rotation_z`` (int16 counts), and ``buttons`` (uint32, one bit each)."""
        axes = [
            pa.field(
                f"{kind}_{axis}", pa.int16(), metadata={"unit": "count", "quantity": "deflection", "component": axis}
            )
            for kind in ("translation", "rotation")
            for axis in AXES
        ]
        return [*axes, pa.field("buttons", pa.uint32(), metadata={"unit": "1", "quantity": "status"})]

    def framer(self) -> Framer:
        """Return a framer that converts each report to a frame with the full state."""
        return StateFramer()

    def decode(self, frames: Frames) -> Samples:
        """Return axes and buttons of frames of `StateFramer`. Battery reports have no sample.

        A list of reports, as returned by `encode`, is decoded from the rest state.
        """
        states = accumulate(frames, np.zeros(FRAME, dtype=np.uint8)) if isinstance(frames, list) else frames
        rows = np.flatnonzero(states[:, 0] != BATTERY)
        axes = np.ascontiguousarray(states[rows, 1:13]).view("<i2").astype(np.int16)
        buttons = np.ascontiguousarray(states[rows, 13:]).view("<u4").astype(np.uint32)
        return Samples((axes, buttons), rows=rows)

    def encode(self, samples: Samples) -> list[bytes]:
        """Return one report per sample, with the part that differs from the previous sample (initially from rest).

        A report contains only one part. If several differ, the buttons take precedence, then rotation if it is ``split``.
        """
        axes, buttons = samples.values
        axes_bytes = np.ascontiguousarray(axes, "<i2").view(np.uint8)
        state = np.hstack([axes_bytes, np.ascontiguousarray(buttons, "<u4").view(np.uint8)])  # (sample, byte)
        differs = np.diff(state.astype(np.int16), axis=0, prepend=0) != 0
        reported = np.where(differs[:, 6:12].any(axis=1) & self.split, ROTATION, TRANSLATION)
        reported[differs[:, 12:].any(axis=1)] = BUTTONS
        reports = []
        for number, row in zip(reported.tolist(), state, strict=True):
            part = row[:12] if number == TRANSLATION and not self.split else row[PARTS[number]]
            reports.append(bytes([number]) + part.tobytes())
        return reports


class StateFramer:
    """Treat each packet as a report, and return the resulting state as a frame of 17 bytes.

    The account counts the bytes of the reports.
    """

    def __init__(self) -> None:
        self.account = Account()
        self._state = np.zeros(FRAME, dtype=np.uint8)

    def feed(self, chunks: Chunks) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Return one frame per report, and invalid packets as losses."""
        self.account.received += len(chunks.data)
        packets = chunks.packets()
        good = np.array([len(packet) in SIZES.get(packet[0] if packet else 0, ()) for packet in packets], dtype=bool)
        reports = [packet for packet, is_good in zip(packets, good, strict=True) if is_good]
        losses = [FramingLoss(int(chunks.t_ns[row]), MALFORMED, 1, len(packets[row])) for row in np.flatnonzero(~good)]
        self.account.framed += sum(len(report) for report in reports)
        self.account.lost += sum(loss.bytes for loss in losses)
        if not reports:
            return [], losses
        frames = accumulate(reports, self._state)
        self._state = frames[-1].copy()
        return [FrameRun(frames, chunks.t_ns[good])], losses

    def flush(self) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Return nothing: reports are never incomplete."""
        return [], []


def accumulate(reports: Sequence[bytes], state: Bytes) -> Bytes:
    """Return the state (report, 17) after each of ``reports``, starting from ``state`` (17,)."""
    sizes = np.array([len(report) for report in reports])
    padded = np.frombuffer(b"".join(report.ljust(MAX_REPORT, b"\0") for report in reports), np.uint8).reshape(
        -1, MAX_REPORT
    )
    number = padded[:, 0]
    frames = np.vstack([state, np.zeros((len(reports), FRAME), dtype=np.uint8)])
    frames[1:, 0] = number
    is_both = (number == TRANSLATION) & (sizes == MAX_REPORT)
    _fill_forward(frames[:, 1:], PARTS[TRANSLATION], number == TRANSLATION, padded[:, 1:7])
    rotation = np.where(is_both[:, None], padded[:, 7:13], padded[:, 1:7])
    _fill_forward(frames[:, 1:], PARTS[ROTATION], (number == ROTATION) | is_both, rotation)
    _fill_forward(frames[:, 1:], PARTS[BUTTONS], number == BUTTONS, padded[:, 1:5])
    return frames[1:]


def _fill_forward(frames: Bytes, part: slice, reported: Bools, sent: Bytes) -> None:
    """Write a part of the state into ``frames``. The first row is the previous state; unreported rows repeat the last."""
    frames[1:, part][reported] = sent[reported]
    last = np.maximum.accumulate(np.where(reported, np.arange(1, len(reported) + 1), 0))
    frames[1:, part] = frames[last, part]
