"""Join the streams of an outlet that stopped and started again, and name streams that were recorded twice."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.channels.lsl import LslDescription
from tacpipe.printable import listed, plain

if TYPE_CHECKING:
    from tacpipe.formats.xdf_streams import StreamReading

Streams = Mapping[int, "StreamReading"]  # streams with times by number


def join_restarts(streams: Streams) -> list[list[int]]:
    """Return the numbers of streams in groups: streams of one outlet that do not overlap, in the order of time.

    They have the same name and channels, and the same source or computer.
    """
    groups = [[number] for number in streams]
    for identity in ("source_id", "host"):
        alike: dict[object, list[list[int]]] = {}
        for group in groups:
            about = streams[group[0]].about
            is_identified = about.name and (identity == "host" or about.source_id)
            key = (*_kind(about), getattr(about, identity)) if is_identified else group[0]
            alike.setdefault(key, []).append(group)
        groups = []
        for same in alike.values():
            same.sort(key=lambda group: int(streams[group[0]].t_ns[0]))
            overlap = any(_gap_ns(streams, before, after) <= 0 for before, after in itertools.pairwise(same))
            groups += same if overlap else [list(itertools.chain(*same))]
    return groups


def _kind(about: LslDescription) -> tuple[object, ...]:
    return about.name, about.kind, about.format, about.rate_hz, about.channels


def _gap_ns(streams: Streams, before: Sequence[int], after: Sequence[int]) -> int:
    return int(streams[after[0]].t_ns[0] - streams[before[-1]].t_ns[-1])


def describe_groups(streams: Streams, groups: Sequence[list[int]], sources: Mapping[int, str]) -> Iterator[str]:
    """Yield sentences about joined streams, streams of one name that are not joined, and equal streams."""
    names = {number: plain(source) for number, source in sources.items()}
    for group in groups:
        gaps = [f"{_gap_ns(streams, [a], [b]) / 1e9:.3f} s" for a, b in itertools.pairwise(group)]
        if gaps:
            parts = listed([names[number] for number in group], 4)
            yield f"{parts} are one stream that stopped and started again, with gaps of {listed(gaps, 4)}."
    ordered = sorted(groups, key=lambda group: (streams[group[0]].about.name, int(streams[group[0]].t_ns[0])))
    for before, after in itertools.pairwise(ordered):
        gap_s = _gap_ns(streams, before, after) / 1e9
        span_s = min(int(streams[group[-1]].t_ns[-1] - streams[group[0]].t_ns[0]) for group in (before, after)) / 1e9
        if streams[before[0]].about.name == streams[after[0]].about.name and gap_s > -span_s / 2:
            side = f"{abs(gap_s):.3f} s {'after' if gap_s > 0 else 'before'} the end of the first"
            yield (
                f"{names[before[-1]]} and {names[after[0]]} have one name, and the second starts {side}. They are two "
                f"streams, because they overlap, or have other channels or computers. If one is needless, exclude it "
                f"with `--without`: rows need all streams."
            )
    for first, second in itertools.combinations(streams, 2):
        if _are_equal(streams[first], streams[second]):
            yield (
                f"{names[first]} and {names[second]} have equal stamps and values: the stream was recorded twice. "
                f"Exclude one with `--without`."
            )


def _are_equal(first: StreamReading, second: StreamReading) -> bool:
    if first.rows != second.rows or first.about.format != second.about.format:
        return False
    stamps_are_equal = np.array_equal(np.concatenate(first.stamps), np.concatenate(second.stamps))
    return stamps_are_equal and _channel_digests(first) == _channel_digests(second)


def _channel_digests(stream: StreamReading) -> list[str]:
    digests = [hashlib.sha256() for _ in stream.fields]
    for columns in stream.channels():
        for digest, column in zip(digests, columns, strict=True):
            is_text = stream.about.is_text
            digest.update("\0".join([*column.to_pylist(), ""]).encode() if is_text else column.to_numpy().tobytes())
    return [digest.hexdigest() for digest in digests]
