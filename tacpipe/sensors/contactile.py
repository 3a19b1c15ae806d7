"""Contactile PapillArray sensors behind their controller, which sends PTS v2.0 over USB.

Each sensor has pillars with force and displacement, and a total force and torque; the controller can also detect slip.
`tacpipe.sensors.pts` describes the frames. Commands are lines of text: ``f1000`` sets the rate, ``z`` zeroes the load, ``S``
and ``s`` turn slip detection on and off. They are not answered.
Source: facts from the packages papillarray_hardware and contactile-papillarray-ros2.

The controller buffers frames of its last session and sends them first; `FreshFramer` drops them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tacpipe.arrays import AnyArray, Bytes, Float32s, Int64s
from tacpipe.channels.schema import AXES
from tacpipe.errors import DeviceError, UsageError
from tacpipe.sensors import pts
from tacpipe.sensors.byte_framer import ByteFramer
from tacpipe.sensors.checks import sum16
from tacpipe.sensors.framing import Framer, Framing
from tacpipe.sensors.pts import FreshFramer
from tacpipe.sensors.sensor import Ask, Dialogue, LocalAddress, Samples, Sensor

RATES = (100, 250, 500, 1000)
COUNTER = 1 << 32
MAX_SIZE = 8192  # maximum size of a frame in bytes
JUMP_S = 0.25  # a counter that jumps by more than this time is a new session, not a loss


@dataclass(frozen=True)
class Contactile(Sensor):
    """PapillArray sensors behind one controller."""

    summary: ClassVar[str] = "Contactile PapillArray sensors behind their controller (PTS v2.0)."
    counter: ClassVar[int | None] = COUNTER

    sensors: int = 2  # number of sensors on the controller
    pillars: int = 9  # number of pillars per sensor
    slip: bool = False  # detect slip, and record states and friction of pillars and sensors
    rate_hz: float = 500.0  # frames per second: 100, 250, 500 or 1000
    baud: int = 115200  # baud rate; any rate works over USB

    def __post_init__(self) -> None:
        if self.rate_hz not in RATES:
            raise UsageError(
                f"contactile: rate_hz is {self.rate_hz:g}; it must be one of {', '.join(map(str, RATES))}."
            )
        if self.sensors < 1 or self.pillars < 1 or self.sensors * self.pillars > 200:
            raise UsageError(
                f"contactile: sensors is {self.sensors} and pillars {self.pillars}; "
                f"both must be at least 1, and their product at most 200."
            )

    def fields(self) -> list[pa.Field]:
        """Return the fields in the order of the blocks, and within a block in the order of the sensors.

        ``sensor1_pillar1_force_x_n`` and ``…_displacement_x_mm`` of all pillars, then ``sensor1_force_x_n`` and
        ``…_torque_x_n_mm``, float32. With slip also ``sensor1_pillar1_slip`` (int8), ``sensor1_pillar1_friction`` (float32),
        ``sensor1_slip`` (uint8: 0 detection off, 1 on, 2 on and the reference pillar is loaded), ``sensor1_friction`` and
        ``sensor1_grip_force_n`` (float32).
        """
        sensors = [(f"sensor{number}", {"sensor": str(number)}) for number in range(1, self.sensors + 1)]
        pillars = [
            (f"{name}_pillar{pillar}", {**layout, "taxel": str(pillar)})
            for name, layout in sensors
            for pillar in range(1, self.pillars + 1)
        ]
        status, newton = {"unit": "1", "quantity": "status"}, {"unit": "N", "quantity": "force"}
        friction = {"unit": "1", "quantity": "friction"}
        fields = [
            field
            for pillar in pillars
            for field in (*_vector_fields(*pillar, "force", "N"), *_vector_fields(*pillar, "displacement", "mm"))
        ]
        fields += [
            field
            for sensor in sensors
            for field in (*_vector_fields(*sensor, "force", "N"), *_vector_fields(*sensor, "torque", "N mm"))
        ]
        if self.slip:
            fields += [pa.field(f"{name}_slip", pa.int8(), metadata=status | layout) for name, layout in pillars]
            fields += [
                pa.field(f"{name}_friction", pa.float32(), metadata=friction | layout) for name, layout in pillars
            ]
            fields += [pa.field(f"{name}_slip", pa.uint8(), metadata=status | layout) for name, layout in sensors]
            for name, layout in sensors:
                fields.append(pa.field(f"{name}_friction", pa.float32(), metadata=friction | layout))
                fields.append(pa.field(f"{name}_grip_force_n", pa.float32(), metadata=newton | layout))
        return fields

    def framer(self) -> Framer:
        """Return a framer for frames with a right sum and valid tables, without frames of the last session."""
        framing = Framing(marker=pts.MARKER, tail=pts.TAIL, max_size=MAX_SIZE, check=pts.are_valid)
        return FreshFramer(ByteFramer(framing), self._counters, COUNTER, round(JUMP_S * self.rate_hz))

    @staticmethod
    def _counters(frames: Bytes) -> Int64s:
        """Return the hub's counter in each frame (frame,)."""
        counters = np.zeros(len(frames), dtype=np.int64)
        for rows, layout in pts.layouts(frames):
            assert layout is not None  # checked by the framer
            counters[rows] = _gather(frames[rows], layout.offsets(pts.HUB), 4).view("<u4")[:, 0, 0]
        return counters

    def decode(self, frames: Bytes) -> Samples:
        """Return the values of all blocks, with the hub's counter and time.

        With ``slip``, frames without slip blocks, which the controller sends before detection starts, are skipped. Raises
        `DeviceError` if the controller has other sensors than the options.
        """
        decoded_parts: list[tuple[Int64s, tuple[AnyArray, ...], NDArray[np.uint8]]] = []
        for rows, layout in pts.layouts(frames):
            assert layout is not None  # checked by the framer
            if layout.counts != (self.pillars,) * self.sensors:
                raise DeviceError(
                    f"The controller has sensors with {', '.join(map(str, layout.counts)) or 'no'} pillars, but the options "
                    f"declare {self.sensors} with {self.pillars}; correct sensors and pillars."
                )
            if self.slip and not layout.has_slip:
                continue
            selected = frames[rows]
            decoded_parts.append(
                (rows, self._values(selected, layout), _gather(selected, layout.offsets(pts.HUB), 12)[:, 0])
            )
        if not decoded_parts:
            return self._empty_samples()
        rows = np.concatenate([part[0] for part in decoded_parts])
        order = np.argsort(rows, kind="stable")
        hub = np.concatenate([part[2] for part in decoded_parts])[order]
        values = tuple(
            np.concatenate(blocks)[order] for blocks in zip(*(part[1] for part in decoded_parts), strict=True)
        )
        seq = np.ascontiguousarray(hub[:, :4]).view("<u4")[:, 0].astype(np.int64)
        t_us = np.ascontiguousarray(hub[:, 4:]).view("<u8")[:, 0].astype(np.int64)
        return Samples(values, seq=seq, t_device_ns=t_us * 1000, rows=rows[order])

    def _empty_samples(self) -> Samples:
        """Return samples without rows, in blocks of the right types."""
        no_rows = np.zeros(0, dtype=np.int64)
        layout = pts.parse(pts.template(self.sensors, self.pillars, slip=self.slip))
        return Samples(
            self._values(np.zeros((0, MAX_SIZE), dtype=np.uint8), layout),
            seq=no_rows,
            t_device_ns=no_rows,
            rows=no_rows,
        )

    def _values(self, frames: Bytes, layout: pts.PtsLayout) -> tuple[AnyArray, ...]:
        """Return forces (frame, channel), and with ``slip`` also states, friction, totals and grip forces."""
        forces = np.hstack(
            [_floats(_gather(frames, layout.offsets(block), 24)) for block in (pts.PILLARS, pts.SENSORS)]
        )
        if not self.slip:
            return (forces,)
        slips = _gather(frames, layout.offsets(pts.PILLAR_SLIP), 5)
        totals = _gather(frames, layout.offsets(pts.SENSOR_SLIP), 9)
        return forces, slips[..., 0].view(np.int8), _floats(slips[..., 1:]), totals[..., 0], _floats(totals[..., 1:])

    def encode(self, samples: Samples) -> Bytes:
        """Return the frames of these samples."""
        assert samples.seq is not None and samples.t_device_ns is not None
        frame = pts.template(self.sensors, self.pillars, slip=self.slip)
        layout = pts.parse(frame)
        count = len(samples.seq)
        frames = np.tile(np.frombuffer(frame, np.uint8), (count, 1))
        counter = (samples.seq % COUNTER).astype("<u4")[:, None].view(np.uint8)
        t_us = (samples.t_device_ns // 1000).astype("<u8")[:, None].view(np.uint8)
        _scatter(frames, layout.offsets(pts.HUB), np.hstack([counter, t_us])[:, None])
        forces, *slip = samples.values
        entries = _bytes(forces, 24)  # bytes of all pillars, then those of the sensors
        _scatter(frames, layout.offsets(pts.PILLARS), entries[:, : -self.sensors])
        _scatter(frames, layout.offsets(pts.SENSORS), entries[:, -self.sensors :])
        if self.slip:
            states, friction, watched, grips = slip
            entries = np.concatenate([states.view(np.uint8)[..., None], _bytes(friction, 4)], axis=2)
            _scatter(frames, layout.offsets(pts.PILLAR_SLIP), entries)
            _scatter(
                frames, layout.offsets(pts.SENSOR_SLIP), np.concatenate([watched[..., None], _bytes(grips, 8)], axis=2)
            )
        start, stop = len(pts.MARKER), -len(pts.TAIL)
        frames[:, stop - 2 : stop] = sum16(frames[:, start : stop - 2]).astype("<u2")[:, None].view(np.uint8)
        return frames

    def opening(self, local: LocalAddress) -> Dialogue:
        """Set the rate, and turn slip detection on or off."""
        yield Ask(f"f{self.rate_hz:.0f}\n".encode(), pause_s=0.1)
        yield Ask(b"S\n" if self.slip else b"s\n")

    def taring(self) -> Dialogue:
        """Zero the load. Nothing may touch the pillars for the two seconds that this takes."""
        yield Ask(b"z\n", pause_s=2.0)


def _vector_fields(prefix: str, layout: Mapping[str, str], quantity: str, unit: str) -> list[pa.Field]:
    """Return the float32 fields of a vector: x, y and z, with ``layout`` in their metadata."""
    suffix = unit.replace(" ", "_").lower()
    return [
        pa.field(
            f"{prefix}_{quantity}_{axis}_{suffix}",
            pa.float32(),
            metadata={"unit": unit, "quantity": quantity, **layout, "component": axis},
        )
        for axis in AXES
    ]


def _gather(frames: Bytes, offsets: Int64s, size: int) -> Bytes:
    """Return ``size`` bytes at each offset, shape (frame, offset, byte)."""
    return np.ascontiguousarray(frames[:, offsets[:, None] + np.arange(size)])


def _scatter(frames: Bytes, offsets: Int64s, values: Bytes) -> None:
    frames[:, offsets[:, None] + np.arange(values.shape[2])] = values


def _floats(data: Bytes) -> Float32s:
    """Return the floats of entries (frame, entry, byte) as (frame, float)."""
    floats = np.ascontiguousarray(data).view("<f4").astype(np.float32)
    return floats.reshape(len(data), floats.shape[1] * floats.shape[2])


def _bytes(values: AnyArray, size: int) -> Bytes:
    """Return values (frame, float) as entries (frame, entry, byte) of ``size`` bytes."""
    return np.ascontiguousarray(values, "<f4").view(np.uint8).reshape(len(values), -1, size)
