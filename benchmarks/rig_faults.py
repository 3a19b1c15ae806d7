"""Harm the bytes of every sensor for minutes of its own time, and hold what its driver gives against what was sent.

    python -m benchmarks.rig_faults [--minutes 5] [--only tfmini contactile] [--faults noise=1,cut=1]

Nothing waits: the clock is the emulator's. A sample that was never sent is an error, unless the harm made a frame that the
protocol itself takes for good (`invisible`: nothing in it could tell). Printed are, for each sensor, what was done to it,
the samples that came, those that were lost and what the driver says was lost, and the most unharmed frames in a row that
were not given out after a disturbance.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tacpipe.recording import rig as rig_of
from tacpipe.recording.reading import Batch, LinkReader
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Samples
from tests.emulation import byte_faults
from tests.emulation import ledger as ledgers
from tests.emulation.byte_faults import Faults, SentItem
from tests.emulation.emulator import DEFAULT_HZ, PACKETS, Emulator, frame_pace
from tests.emulation.ledger import Ledger
from tests.emulation.transmission import TransmissionPlan

RIG = Path(__file__).parents[1] / "rigs/all-sensors.toml"
USUAL = Faults(
    noise=0.3,
    cut=0.3,
    flip=0.3,
    burst=0.3,
    drop=0.001,
    duplicate=0.001,
    reorder=0.001,
    stall=0.05,
    unplug=0.02,
    wrap_s=30,
)


@dataclass(frozen=True)
class Outcome:
    """Counts of a sensor's frames under faults."""

    name: str
    harmed: dict[str, int]
    sent: int  # samples that went out unharmed
    delivered: int  # samples that the driver gave
    wrong: int  # delivered samples that were never sent, and that the protocol could have detected
    invisible: int  # delivered samples of frames whose harm the protocol cannot detect
    lost: int  # samples between the first and the last given that were not, harmed or not sent
    reported_lost: int  # samples that the driver reports as lost
    longest: int  # unharmed frames in a row right behind a disturbance that were not given
    causes: dict[str, int]


def outcome(name: str, seconds: float, faults: Faults) -> Outcome:
    """Return what became of ``seconds`` of a stream of the rig of all sensors."""
    emulator = Emulator(rig_of.read(RIG), seed=1, faults=faults)
    stream = emulator.rig_file.streams[name]
    its_pace, rate_hz = frame_pace(emulator.rig_file, name), stream.sensor.rate_hz or DEFAULT_HZ
    source = emulator.source(name, its_pace, rate_hz)
    packets = stream.address.scheme in PACKETS
    plan = TransmissionPlan(source, its_pace, faults, [1], packets=packets)
    ledger, reading = Ledger(name), LinkReader(source.sensor)
    ledger.sources.append(source)
    batches: list[Batch] = []
    harmed: Counter[str] = Counter()
    away = False
    while plan.planned_ns < seconds * 1e9:
        for item in plan.next_items():
            if item.number < 0 and item.cause in (byte_faults.UNPLUG, byte_faults.REPLUG):
                away = item.cause == byte_faults.UNPLUG
                harmed[item.cause] += 1
                if away:
                    batches.append(reading.end_link())
                continue
            size = 0 if away else len(item.data)
            cause = byte_faults.GONE if away and item.data else item.cause
            ledger.add(item, item.due_ns, max(1, item.due_ns), size, cause)
            harmed.update([cause] if cause else [])
            if size:
                batches.append(reading.feed(_chunks(item, packets=packets)))
    batches.append(reading.finish())
    return _compare_with_sent(name, ledger, batches, reading, dict(harmed))


def _chunks(item: SentItem, *, packets: bool) -> Chunks:
    """Return an item as a link would give it; a link of bytes in two pieces."""
    half = len(item.data) // 2
    pieces = [item.data] if packets or not half else [item.data[:half], item.data[half:]]
    return Chunks.from_pairs([(item.due_ns, piece) for piece in pieces])


def _compare_with_sent(
    name: str, ledger: Ledger, batches: list[Batch], reading: LinkReader, harmed: dict[str, int]
) -> Outcome:
    """Hold samples against what was sent: in the order of their sending, by all that they say."""
    sent = ledger.samples()
    assert sent.rows is not None
    unharmed = ledger.intact_rows
    sent_keys = _keys(sent, reading)
    places: dict[bytes, list[int]] = {}
    for place, key in enumerate(sent_keys):
        places.setdefault(key, []).append(place)
    delivered = np.zeros(len(sent_keys), dtype=bool)
    wrong, last = 0, -1
    delivered_keys = [key for batch in batches if len(batch) for key in _keys(batch, reading)]
    for key in delivered_keys:
        candidates = places.get(key, [])
        if not candidates:
            wrong += 1
            continue
        place = min(candidates, key=lambda candidate: abs(candidate - last - 1))
        delivered[place], last = True, place
    entries = unharmed[sent.rows]  # (sample,), the entry of each
    invisible = int(ledger.column("invisible").sum())
    first, final = int(delivered.argmax()), len(delivered) - 1 - int(delivered[::-1].argmax())
    numbers = ledger.column("number")
    span = int(numbers[entries[final]] - numbers[entries[first]]) + 1
    unwanted = min(wrong, invisible * max(1, len(sent_keys) // max(1, len(unharmed))))
    causes = Counter[str]()
    for batch in batches:
        for event in batch.events:
            causes[event.cause] += 1
    lost = span - len(np.unique(entries[first : final + 1][delivered[first : final + 1]]))
    return Outcome(
        name, harmed, len(sent_keys), len(delivered_keys), wrong - unwanted, unwanted, lost,
        reading.losses.certain + reading.losses.estimated, _longest(ledger, entries[delivered]), dict(causes),
    )  # fmt: skip


def _keys(samples: Samples | Batch, reading: LinkReader) -> list[bytes]:
    """Return for each sample all that it says, its counter as the frame holds it."""
    modulus = reading.sensor.counter
    columns = [column for block in samples.values for column in block.T]
    if samples.seq is not None and modulus is not None:
        unrolled = isinstance(samples, Batch)
        columns.append(samples.seq * reading.sensor.step % modulus if unrolled else samples.seq)
    return ledgers.keys(columns)


def _longest(ledger: Ledger, delivered_rows: np.ndarray) -> int:
    """Return the most unharmed frames in a row right behind a disturbance, with more behind them, that were not given."""
    delivered = np.zeros(len(ledger), dtype=bool)
    delivered[delivered_rows] = True
    unharmed = np.zeros(len(ledger), dtype=bool)
    unharmed[ledger.intact_rows] = True
    longest = run = 0
    counting = False
    for good, was_delivered in zip(unharmed.tolist(), delivered.tolist(), strict=True):
        if not good:
            counting, run = True, 0
        elif was_delivered:
            longest, counting = max(longest, run if counting else 0), False
        elif counting:
            run += 1
    return longest


def main() -> None:
    """Harm each sensor and print what became of it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--only", nargs="+")
    parser.add_argument("--faults", help="such as noise=0.5,drop=0.001; a little of everything by default")
    chosen = parser.parse_args()
    faults = byte_faults.parse(chosen.faults) if chosen.faults else USUAL
    print("| sensor | harmed | given | wrong | invisible | lost | told as lost | not given behind a disturbance |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    failed = False
    for name in chosen.only or rig_of.read(RIG).streams:
        began_s = time.monotonic()
        result = outcome(name, 60 * chosen.minutes, faults)
        failed |= bool(result.wrong)
        harmed = sum(result.harmed.values())
        print(
            f"| {name} | {harmed} | {result.delivered:,} | {result.wrong} | {result.invisible} | {result.lost} | "
            f"{result.reported_lost} | "
            f"{result.longest} |", flush=True,
        )  # fmt: skip
        print(
            f"{name}: {result.harmed} {result.causes}, {time.monotonic() - began_s:.0f} s", file=sys.stderr, flush=True
        )
    raise SystemExit(int(failed))


if __name__ == "__main__":
    main()
