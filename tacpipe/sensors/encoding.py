"""Arrange columns for `Sensor.encode`, and split what it returns into frames as they are sent."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, cast

import numpy as np

from tacpipe.arrays import AnyArray
from tacpipe.sensors.byte_framer import LineFramer
from tacpipe.sensors.sensor import Frames, Sensor

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


def value_blocks(sensor: Sensor, columns: Sequence[AnyArray]) -> tuple[AnyArray, ...]:
    """Return the columns (sample,) of a sensor's fields as the blocks (sample, channel) of `Samples.values`.

    A block is a run of fields of one type, or an output of a sensor whose outputs are selected in the rig file.
    """
    fields = sensor.fields()
    outputs: Sequence[str] | None = getattr(sensor, "outputs", None)
    if outputs:
        options = cast("DataclassInstance", sensor)
        widths = [len(replace(options, outputs=(name,)).fields()) for name in outputs]  # type: ignore[attr-defined]
    else:
        starts = [row for row in range(len(fields)) if not row or fields[row - 1].type != fields[row].type]
        widths = np.diff([*starts, len(fields)]).tolist()
    edges = [0, *np.cumsum(widths).tolist()]
    return tuple(np.column_stack(columns[start:stop]) for start, stop in itertools.pairwise(edges))


def split_frames(sensor: Sensor, frames: Frames) -> list[bytes]:
    """Return the encoded frames as bytes, as they are sent: lines with their line ends."""
    if isinstance(frames, np.ndarray):
        size, content = frames.shape[1], np.ascontiguousarray(frames).tobytes()
        return [content[start : start + size] for start in range(0, len(content), size)]
    if isinstance(sensor.framer(), LineFramer):
        return [frame if frame.endswith(b"\n") else frame + b"\r\n" for frame in frames]
    return list(frames)
