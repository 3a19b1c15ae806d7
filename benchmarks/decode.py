"""Measure decoding from bytes to samples, next to the vendors' own parsers on the same bytes.

Ours is the framer and `decode`; the vendors' are fed through an object in place of the serial port, and called as their
users call them. In bulk we get all bytes at once, as when a recording is sealed; live, in pieces of a tenth of a second at
the product's own rate, where most of the time goes into each piece and not into its frames. Both must give the same numbers.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import optoforce
import timing
from anyskin.sensor import AnySkinBase
from flexitac import FlexiTacSensor
from paxini_sdk import protocol
from paxini_sdk.boards.high_speed import AutoPushConfig, AutoPushFrame
from paxini_sdk.transport import SerialTransport
from pyrobotiqtactile.protocol import PacketParser
from RSIPI.xml_handler import FastXMLParser
from tactile_sdk.protocol.modbus_rtu import ModbusRTU

from tacpipe.arrays import AnyArray
from tacpipe.sensors import anyskin, kuka_rsi
from tacpipe.sensors.anyskin import AnySkin
from tacpipe.sensors.flexitac import FlexiTac
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.kuka_rsi import KukaRsi
from tacpipe.sensors.modbus_tactile import ModbusTactile
from tacpipe.sensors.optoforce import OptoForce
from tacpipe.sensors.paxini import SLOTS, Paxini
from tacpipe.sensors.robotiq import Robotiq
from tacpipe.sensors.sensor import Samples, Sensor

FRAMES, PIECE_S, AIM = 2000, 0.1, 10.0


class Port:
    """Bytes in place of a serial port for vendors' code; at most ``piece_bytes`` can be read at a time."""

    is_open, timeout = True, 0.05

    def __init__(self, data: bytes, piece_bytes: int) -> None:
        self.data, self.place, self.piece_bytes = data, 0, piece_bytes

    @property
    def in_waiting(self) -> int:
        return min(self.piece_bytes, len(self.data) - self.place)

    def read(self, size: int = 1) -> bytes:
        piece = self.data[self.place : self.place + min(size, self.piece_bytes)]
        self.place += len(piece)
        return piece

    def read_until(self, expected: bytes = b"\n") -> bytes:
        stop = self.data.find(expected, self.place)
        return self.read(stop + len(expected) - self.place if stop >= 0 else len(self.data))

    def write(self, data: bytes) -> None: ...

    def reset_input_buffer(self) -> None: ...


class AnySkinOnBytes(AnySkinBase):  # type: ignore[misc]
    """AnySkin's parser without a port."""

    def __init__(self, data: bytes, burst: bool) -> None:
        port = Port(data, 3000)
        self.num_mags, self.burst_mode, self._msg_floats, self._msg_length = 5, burst, 20, 82
        self._temp_mask = np.ones(20, dtype=bool)
        self.read, self.read_until, self.port_of_bytes = port.read, port.read_until, port

    @property
    def in_waiting(self) -> int:
        return self.port_of_bytes.in_waiting

    def readline(self, size: int | None = -1) -> bytes:
        return self.port_of_bytes.read_until(b"\n")

    def __del__(self) -> None: ...


@dataclass(frozen=True)
class Contest:
    """A driver with frames, and the vendor's parser, which gives the same numbers of each."""

    name: str
    sensor: Sensor
    frames: Any  # (frame, byte), or lines
    vendor: Callable[[bytes, int], AnyArray]  # Arguments: all bytes, and how many come in a piece.
    ours: Callable[[Samples], AnyArray]  # the numbers of samples as the vendor gives them

    packets: bool = False  # a link gives the frames one by one
    forget: Callable[[], object] = dict  # Clears what the driver caches of texts, so that each round reads them anew.

    @functools.cached_property
    def data(self) -> bytes:
        """The bytes of all frames."""
        return b"".join(bytes(frame) for frame in self.frames)

    @property
    def live(self) -> int:
        """How many frames come in a piece."""
        return max(1, int(self.sensor.rate_hz * PIECE_S))

    def read_pieces(self, count: int) -> Iterator[Chunks]:
        """Yield what a link delivers of so many frames at a time."""
        if self.packets:
            for start in range(0, FRAMES, count):
                yield Chunks.from_pairs(enumerate(self.frames[start : start + count]))
            return
        size = int(len(self.data) / FRAMES * count)
        for place in range(0, len(self.data), size):
            yield Chunks.from_pairs([(place, self.data[place : place + size])])

    def read(self, count: int) -> AnyArray:
        """Return what our driver makes of the bytes of so many frames at a time."""
        self.forget()
        framer, decoded = self.sensor.framer(), []
        for chunks in self.read_pieces(count):
            runs, _ = framer.feed(chunks)
            decoded += [self.sensor.decode(run.frames) for run in runs]
        runs, _ = framer.flush()
        decoded += [self.sensor.decode(run.frames) for run in runs]
        columns = zip(*(samples.values for samples in decoded), strict=True)
        return self.ours(Samples(tuple(np.concatenate(blocks) for blocks in columns)))


def measure(folder: Path, rounds: int) -> list[timing.Line]:
    """Return how many times as fast as the vendors' parsers the drivers are, in bulk and in pieces as they come."""
    return [line for contest in contests() for line in _measure(contest, max(3, rounds // 4))]


def _measure(contest: Contest, rounds: int) -> Iterator[timing.Line]:
    data, live = contest.data, contest.live
    size = int(len(data) / FRAMES * live)
    theirs = contest.vendor(data, size)
    for count in (FRAMES, live):
        ours = contest.read(count)
        lost = len(theirs) - len(ours)
        first = int(contest.name in HEADLESS)
        assert 0 <= lost <= 1 and np.array_equal(ours, theirs[first : first + len(ours)]), contest.name
    times = timing.interleaved(
        {
            "bulk": lambda: contest.read(FRAMES),
            "live": lambda: contest.read(live),
            "vendor": lambda: contest.vendor(data, size),
        },
        rounds,
    )
    for name in ("bulk", "live"):
        speedup = timing.ratio(times, "vendor", name)
        aim = AIM if name == "bulk" else None
        yield timing.Line(
            f"{contest.name}, {'in bulk' if name == 'bulk' else f'{live} frames at a time'}",
            _rate(timing.median(times, name)),
            f"vendor: {_rate(timing.median(times, 'vendor'))}",
            f"{speedup:.1f} times as fast",
            "" if aim is None else f"{aim:g} times as fast",
            None if aim is None else speedup >= aim,
        )


def _rate(seconds: float) -> str:
    return f"{FRAMES / seconds:,.0f} frames/s"


HEADLESS = ("anyskin", "anyskin, ASCII")  # the first frame is lost: where it begins is known behind an end alone


def contests() -> list[Contest]:
    """Return what is measured, each with frames of random numbers."""
    rng = np.random.default_rng(0)
    first_contests = [_flexitac(rng), _anyskin(rng, "binary"), _anyskin(rng, "ascii"), _optoforce(rng)]
    return [*first_contests, _paxini(rng), _robotiq(rng), _modbus(rng), _kuka(rng)]


def _flexitac(rng: np.random.Generator) -> Contest:
    sensor = FlexiTac()
    taxels = rng.integers(0, 255, (FRAMES, 384), dtype=np.uint8)

    def vendor(data: bytes, size: int) -> AnyArray:
        client = FlexiTacSensor("nowhere", baseline=0.0)
        client._serial = Port(data, 386)  # The bytes that it reads beyond a frame pile up until it throws them away.
        return np.stack([client.read().raw.ravel() for _ in range(FRAMES)])

    return Contest("flexitac", sensor, sensor.encode(Samples((taxels,))), vendor, lambda samples: samples.values[0])


def _anyskin(rng: np.random.Generator, mode: Any) -> Contest:
    sensor = AnySkin(mode=mode)
    numbers = np.round(rng.normal(0, 300, (FRAMES, 20)), 2).astype(np.float32)

    def vendor(data: bytes, size: int) -> AnyArray:
        client = AnySkinOnBytes(data + data[:600], mode == "binary")  # it reads no frame that is the last
        return np.stack([client.get_sample()[1] for _ in range(FRAMES)]).astype(np.float32)

    name = "anyskin" if mode == "binary" else "anyskin, ASCII"
    frames = sensor.encode(Samples((numbers,)))
    return Contest(name, sensor, frames, vendor, lambda samples: samples.values[0], forget=anyskin._table.cache_clear)


def _daq(rng: np.random.Generator) -> tuple[OptoForce, Samples, Callable[[bytes, int], AnyArray]]:
    status = np.zeros((FRAMES, 1), dtype=np.uint16)
    axes = rng.integers(-3000, 3000, (FRAMES, 6), dtype=np.int16)

    def vendor(data: bytes, size: int) -> AnyArray:
        logging.getLogger("optoforce").setLevel(logging.ERROR)  # it warns that it was not tested
        client = optoforce.OptoForce22("nowhere")
        client.opt_ser, client.close = Port(data, len(data)), lambda: None
        readings = [client.read(only_latest_data=False) for _ in range(FRAMES)]
        scale = np.array([300 / 7925, 300 / 8641, 2000 / 6049, 1, 1, 1])
        counts: AnyArray = np.rint(np.array([reading[2:8] for reading in readings]) / scale).astype(np.int16)
        return counts

    return OptoForce(axes=6), Samples((status, axes), seq=np.arange(FRAMES)), vendor


def _optoforce(rng: np.random.Generator) -> Contest:
    sensor, samples, vendor = _daq(rng)
    return Contest("optoforce", sensor, sensor.encode(samples), vendor, lambda samples: samples.values[1])


def _paxini(rng: np.random.Generator) -> Contest:
    sensor = Paxini(modules=("thumb_tip", "index_tip", "middle_tip"), variants=("DP-S2015-Elite",))
    signed = rng.integers(-128, 128, (FRAMES, 318), dtype=np.int8)
    unsigned = rng.integers(0, 256, (FRAMES, 159), dtype=np.uint8)
    slots = {SLOTS.index(module): count for module, count in sensor.points.items()}
    config = AutoPushConfig(list(slots), True, True, slots)

    def vendor(data: bytes, size: int) -> AnyArray:
        transport = SerialTransport("nowhere")
        transport._ser, frames_of_triples = Port(data, len(data) // FRAMES), []
        for _ in range(FRAMES):
            parsed = protocol.parse_auto_push(transport.read_auto_push_frame())
            frame = AutoPushFrame(config, parsed.error_code, parsed.valid_data, parsed.raw)
            forces, points = frame.resultant_forces, frame.distributed_forces
            frames_of_triples.append([triple for name in forces for triple in (forces[name], *points[name])])
        triples = np.array(frames_of_triples)  # (frame, point, axis)
        return np.hstack([triples[:, :, :2].reshape(FRAMES, -1), triples[:, :, 2]])

    samples = Samples((np.zeros((FRAMES, 1), dtype=np.uint8), signed, unsigned))
    return Contest(
        "paxini",
        sensor,
        sensor.encode(samples),
        vendor,
        lambda samples: np.hstack([forces_and_points.astype(int) for forces_and_points in samples.values[1:]]),
    )


def _robotiq(rng: np.random.Generator) -> Contest:
    sensor = Robotiq()
    taxels = rng.integers(0, 4096, (FRAMES, 56), dtype=np.uint16)
    signed = rng.integers(-3000, 3000, (FRAMES, 22), dtype=np.int16)
    clocks = (np.arange(FRAMES, dtype=np.uint64)[:, None] * np.uint64(10_000)).repeat(2, axis=1)

    def vendor(data: bytes, size: int) -> AnyArray:
        parser, taxels_of_frames = PacketParser(), []
        for place in range(0, len(data), size):
            for packet in parser.feed(data[place : place + size]):
                parser.parse_sensor_packet(packet)
                taxels_of_frames.append([*parser.fingers[0].static_tactile, *parser.fingers[1].static_tactile])
        return np.array(taxels_of_frames)

    frames = sensor.encode(Samples((taxels, signed, clocks)))
    return Contest("robotiq", sensor, frames, vendor, lambda samples: samples.values[0])


def _modbus(rng: np.random.Generator) -> Contest:
    sensor = ModbusTactile()
    taxels = rng.integers(0, 5000, (FRAMES, 60), dtype=np.uint16)

    def vendor(data: bytes, size: int) -> AnyArray:
        client = ModbusRTU(Port(data, 126))
        return np.array([client.read_all_pressure_values_fast(1) for _ in range(FRAMES)])

    return Contest(
        "modbus-tactile", sensor, sensor.encode(Samples((taxels,))), vendor, lambda samples: samples.values[0]
    )


def _kuka(rng: np.random.Generator) -> Contest:
    sensor = KukaRsi()
    no_rotation = np.broadcast_to(np.array([0.0, 0, 0, 1]), (FRAMES, 4))
    joints_rad = rng.uniform(-3, 3, (FRAMES, 6))
    poses = np.hstack([rng.uniform(-2, 2, (FRAMES, 3)), no_rotation])
    frames = sensor.encode(Samples((poses, joints_rad), seq=4 * np.arange(FRAMES)))

    def vendor(data: bytes, size: int) -> AnyArray:
        blank: dict[str, Any] = {
            "RIst": dict.fromkeys("XYZABC", 0.0),
            "AIPos": {f"A{n}": 0.0 for n in range(1, 7)},
            "IPOC": 0,
        }
        parser, parsed, angles_deg = FastXMLParser(blank), dict(blank), []
        for frame in frames:
            parser.parse(frame.decode(), parsed)
            angles_deg.append([*parsed["AIPos"].values()])
        return np.radians(angles_deg)

    forget = kuka_rsi._table.cache_clear
    return Contest("kuka-rsi", sensor, frames, vendor, lambda samples: samples.values[1], packets=True, forget=forget)
