"""Check for recordings with equal or nearly equal content, whatever their names and clocks.

Each row becomes a hash of the values of its channels, and windows of rows become hashes of these. A sketch keeps the
smallest hashes of a recording; two sketches estimate the fraction of windows that two recordings have in common. Single
rows of unlike recordings may be equal, long windows of noise are not.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tacpipe.arrays import AnyArray
from tacpipe.checks.check import Check, CheckFinding, Stream
from tacpipe.datasets.dataset import Dataset
from tacpipe.io.hashing import digest

if TYPE_CHECKING:
    import pyarrow as pa

Hashes = NDArray[np.uint64]
WINDOW = 8  # rows of a window, after repeated rows are left out
BLOCK_ROWS = 1 << 18  # windows in memory at once
SKETCH = 512  # largest number of hashes of a stream that are kept
SHARE, WINDOWS = 0.1, 16  # smallest share and number of windows in common that are no coincidence
COMMON = 20  # a window in more recordings than this is a pattern, not a copy


class Duplicates(Check):
    """Find recordings, and streams of a recording, with the same values."""

    def __init__(self) -> None:
        super().__init__()
        self._rows: dict[str, tuple[Stream, Hashes]] = {}  # hash of each row, by stream of the recording
        self._values: dict[str, dict[str, str]] = {}  # digest of the values of each stream, by recording
        self._sketches: dict[str, dict[str, Hashes]] = {}  # keys are stream, then recording
        self._shards: dict[str, list[str]] = {}

    def examine_channel(self, stream: Stream, channel: pa.Field, values: AnyArray) -> None:
        """Add the values of a channel to the hashes of the rows."""
        seed = np.uint64(int.from_bytes(hashlib.blake2b(channel.name.encode(), digest_size=8).digest(), "big"))
        bits = values if values.dtype == np.uint64 else (values.astype(np.float64) + 0.0).view(np.uint64)
        _, rows = self._rows.get(stream.name, (stream, np.zeros(len(values), np.uint64)))
        self._rows[stream.name] = (stream, rows + _mix(bits ^ seed))

    def finish(self, recording: str) -> None:
        """Reduce the streams of a recording to a digest and a sketch each."""
        for name, (stream, rows) in self._rows.items():
            self._values.setdefault(recording, {})[name] = hashlib.blake2b(rows.tobytes(), digest_size=16).hexdigest()
            self._shards.setdefault(recording, []).append(stream.digest)
            sketch = sketch_of(rows)
            if len(sketch) >= WINDOWS:
                self._sketches.setdefault(name, {})[recording] = sketch
        self._rows = {}

    def conclude(self, dataset: Dataset) -> Iterator[CheckFinding]:
        """Yield the groups of equal recordings, pairs of nearly equal ones, and equal streams."""
        groups: dict[str, list[str]] = {}
        for recording, values in self._values.items():
            groups.setdefault(digest(values), []).append(recording)
            for first, second in combinations(sorted(values), 2):
                if values[first] == values[second]:
                    sentence = f"{first} and {second} of {recording} have the same values."
                    repair = f"`tacpipe synchronize --without {second}`, or leave it out of the layout"
                    yield self._finding("equal-streams", [recording], sentence, repair)
        representatives = {names[0] for names in groups.values()}
        for names in groups.values():
            if len(names) > 1:
                sentence = f"{' = '.join(names[:4])}{' …' * (len(names) > 4)} have equal values."
                yield self._finding("equal-recordings", names, sentence, _repair(names))
        for (first, second), share in sorted(self._similar(representatives).items()):
            sentence = f"{first} and {second} have {share:.0%} of their windows in common."
            yield self._finding("similar-recordings", [first, second], sentence, _repair([first, second]))

    def _similar(self, recordings: set[str]) -> dict[tuple[str, str], float]:
        """Return the smallest share in common over the streams that both recordings of a pair have, by pair."""
        shares: dict[tuple[str, str], list[float]] = {}
        for sketches in self._sketches.values():
            names = [name for name in sketches if name in recordings]
            for pair in _candidates(names, sketches):
                shares.setdefault(pair, []).append(common_share(*(sketches[name] for name in pair)))
        streams = {
            name: {stream for stream, sketches in self._sketches.items() if name in sketches}
            for pair in shares
            for name in pair
        }
        return {
            pair: min(values)
            for pair, values in shares.items()
            if min(values) >= SHARE and len(values) == len(streams[pair[0]] & streams[pair[1]])
        }

    def _finding(self, kind: str, names: list[str], sentence: str, repair: str) -> CheckFinding:
        content = [shard for name in names for shard in self._shards[name]]
        return CheckFinding(kind, "", sentence, repair, dict.fromkeys(names, ()), content)


def _repair(names: list[str]) -> str:
    return f"`tacpipe label DATASET {names[-1]} --exclude copy`; `tacpipe split` keeps recordings with equal bytes together"


def _mix(bits: Hashes) -> Hashes:
    """Return well-distributed hashes of 64-bit values (splitmix64)."""
    bits = bits + np.uint64(0x9E3779B97F4A7C15)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))


def sketch_of(rows: Hashes) -> Hashes:
    """Return the smallest hashes of the windows that occur once in the rows (row,), sorted."""
    changed = rows[np.concatenate([[True], rows[1:] != rows[:-1]])] if len(rows) else rows
    first = changed[:BLOCK_ROWS]
    if len(changed) < WINDOW or 2 * len(np.unique(first)) < len(first):  # a few values repeat by chance
        return changed[:0]
    sketch: Hashes = changed[:0]
    for share in (8 * SKETCH / len(changed), 1.0):  # mostly the smallest hashes suffice, which saves memory
        limit = np.uint64(min(share * 2**64, 2**64 - 1))
        smallest = [hashes[hashes <= limit] for hashes in _window_hashes(changed)]
        unique, counts = np.unique(np.concatenate(smallest), return_counts=True)
        sketch = unique[counts == 1][:SKETCH]
        if share >= 1 or len(sketch) == SKETCH:
            break
    return sketch


def _window_hashes(rows: Hashes) -> Iterator[Hashes]:
    """Yield the hashes of all windows of rows, block by block."""
    for first in range(0, len(rows) - WINDOW + 1, BLOCK_ROWS):
        block = rows[first : first + BLOCK_ROWS + WINDOW - 1]
        hashes = np.zeros(len(block) - WINDOW + 1, np.uint64)
        for place in range(WINDOW):
            hashes = _mix(hashes * np.uint64(3) + block[place : place + len(hashes)])
        yield hashes


def common_share(first: Hashes, second: Hashes) -> float:
    """Return the estimated fraction of the windows of the shorter recording that the other one has too."""
    limit = min(sketch[-1] if len(sketch) == SKETCH else np.uint64(2**64 - 1) for sketch in (first, second))
    counts = [int(np.searchsorted(sketch, limit, "right")) for sketch in (first, second)]
    common = len(np.intersect1d(first, second))
    return common / max(1, min(counts)) if common >= WINDOWS else 0.0


def _candidates(names: list[str], sketches: dict[str, Hashes]) -> list[tuple[str, str]]:
    """Return the pairs of recordings with enough windows in common, both orders sorted by name."""
    if len(names) < 2:
        return []
    hashes = np.concatenate([sketches[name] for name in names])
    owners = np.repeat(np.arange(len(names)), [len(sketches[name]) for name in names])
    order = np.argsort(hashes, kind="stable")
    hashes, owners = hashes[order], owners[order]
    starts = np.flatnonzero(np.concatenate([[True], hashes[1:] != hashes[:-1]]))
    stops = np.append(starts[1:], len(hashes))
    pairs: Counter[tuple[int, int]] = Counter()
    for start, stop in zip(starts, stops, strict=True):
        if 1 < stop - start <= COMMON:
            pairs.update(combinations(owners[start:stop].tolist(), 2))
    return [
        tuple(sorted((names[first], names[second])))  # type: ignore[misc]
        for (first, second), count in pairs.items()
        if count >= WINDOWS
    ]
