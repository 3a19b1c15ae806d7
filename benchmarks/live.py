"""What a forecast costs: the first paper's rig through a live session's engine, without links and without waiting.

    python benchmarks/live.py MODEL [--seconds 10] [--quantiles 10,90] [--profile]

The emulated rig's bytes (2 uSkin at 50 Hz, proximity at 400 Hz, an arm at 1 kHz) are decoded, brought onto the rows of the
model and predicted, a grid point at a time, as the model's process does it. Printed is the processor's time of each.
"""

from __future__ import annotations

import argparse
import cProfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from tacpipe.live import messages, opening, own_streams, wire
from tacpipe.live.description import Described, described
from tacpipe.live.options import OWN, Options
from tacpipe.recording import rig as rigs
from tacpipe.recording.spool_blocks import Note
from tacpipe.recording.station import BEGAN
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.live import Live
from tacpipe.simulation.emulation.emulator import Emulator, pace
from tacpipe.tasks.forward.live.engine import EARLY_NS, Engine

RIG = Path(__file__).parents[1] / "rigs/first-paper.toml"
PERIOD_NS, OFFSET_NS, START_NS = 20_000_000, 10**18, 10**12
Sent = list[tuple[int, bytes]]


def sent(rig: rigs.Rig, seconds: float) -> dict[str, Sent]:
    """Return what each stream of the emulated rig sends, with its arrival."""
    emulator = Emulator(rig)
    found: dict[str, Sent] = {}
    for name, stream in rig.streams.items():
        source = emulator.source(name, pace(rig, name), stream.sensor.rate_hz)
        each: Sent = []
        for number in range(int(np.ceil(seconds * source.timing.rate_hz / source.rows))):
            frames = stream.sensor.encode(source.block(number))
            t_ns = START_NS + source.timing.taken_ns(source.numbers(number))
            packets = [frame.tobytes() if isinstance(frame, np.ndarray) else bytes(frame) for frame in frames]
            each += list(zip(t_ns.tolist(), packets, strict=True))
        found[name] = each
    return found


class Replay:
    """An engine that is fed what came, and the processor's time of each step."""

    def __init__(self, model: Path, seconds: float, quantiles: tuple[int, ...] = ()) -> None:
        rig = rigs.read(RIG)
        about, _ = described(model)
        assert isinstance(about, Described), "a model of forward"
        about = replace(about, quantiles=quantiles)
        own = own_streams.added(rig, about, tuple(range(1, about.horizon + 1)))
        self.sensors = {name: own.streams[name].sensor for name in OWN if name in own.streams}
        engine = opening.engine(Options(str(model), own.text, tuple(rig.streams), quantiles=quantiles))
        assert isinstance(engine, Engine)
        self.engine = engine
        self.sent = sent(rig, seconds)
        self.steps = int(seconds * 1e9 / PERIOD_NS)
        self.early_ms: list[float] = []
        self.step_ms: list[float] = []
        self.publish_ms: list[float] = []
        self.json_ms: list[float] = []

    def run(self) -> None:
        """Feed everything, a period at a time."""
        self.engine.take("", Note(START_NS, "", wire.BEGIN, str(OFFSET_NS)))
        for name in self.sent:
            self.engine.take(name, Note(START_NS, name, BEGAN))
        places = dict.fromkeys(self.sent, 0)
        for step in range(self.steps):
            until_ns = START_NS + step * PERIOD_NS + self.engine.settle_ns
            self.give(places, until_ns - EARLY_NS)
            early_s = time.process_time()
            self.engine.step(until_ns - EARLY_NS)
            self.early_ms.append((time.process_time() - early_s) * 1e3)
            self.give(places, until_ns)
            began_s = time.process_time()
            found = self.engine.step(until_ns)
            stepped_s = time.process_time()
            for message in found:
                for sensor in self.sensors.values():
                    assert isinstance(sensor, Live)
                    messages.packets(message, sensor, 0)
                packed_s = time.process_time()
                messages.to_json(message.to_dict())
                if message.values is not None:
                    self.step_ms.append((stepped_s - began_s) * 1e3)
                    self.publish_ms.append((packed_s - stepped_s) * 1e3)
                    self.json_ms.append((time.process_time() - packed_s) * 1e3)

    def give(self, places: dict[str, int], until_ns: int) -> None:
        """Give the engine what came by then."""
        for name, each in self.sent.items():
            first = last = places[name]
            while last < len(each) and each[last][0] <= until_ns:
                last += 1
            for one in each[first:last]:
                self.engine.take(name, Chunks.of([one]))
            places[name] = last


def main() -> None:
    """Run and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("model", type=Path)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--quantiles", default="", help="levels that are published, in percent, of a calibrated model")
    parser.add_argument("--profile", action="store_true")
    chosen = parser.parse_args()
    levels = tuple(int(level) for level in chosen.quantiles.split(",") if level)
    replay = Replay(chosen.model, chosen.seconds, levels)
    if chosen.profile:
        with cProfile.Profile() as profile:
            replay.run()
        profile.print_stats("cumulative")
    else:
        replay.run()
    print("| part | median ms | 99 % ms | largest ms | forecasts |")
    print("| --- | --- | --- | --- | --- |")
    for name, each in (
        ("decoding before a row is due", replay.early_ms),
        ("from a row's due time: rest of decoding, row, forecast, alarms", replay.step_ms),
        ("packets of the session's own streams", replay.publish_ms),
        ("JSON", replay.json_ms),
    ):
        if each:
            print(f"| {name} | {np.median(each):.2f} | {np.quantile(each, 0.99):.2f} | {max(each):.2f} | {len(each)} |")


if __name__ == "__main__":
    main()
