"""Counters of few bits that ran over their end."""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import AnyArray

HALF, RANGE = 1 << 15, 1 << 16  # of counts of 16 bits


def unwrapped(values: AnyArray) -> AnyArray:
    """Return ``values`` (time,), integers of 16 bits, with wrap-around undone, as int32; as they are where there is none.

    A jump of more than half the range between consecutive samples is one, the other way round the range: no signal that
    is sampled well moves so far. Real uSkin frames jump by 5,000 counts at most.

    >>> unwrapped(np.array([65_530, 65_535, 4, 65_534], dtype=np.uint16)).tolist()
    [65530, 65535, 65540, 65534]
    """
    if len(values) < 2 or int(values.max()) - int(values.min()) <= HALF:
        return values
    wide = values.astype(np.int32)
    turned = turns(wide)
    if not turned.any():
        return values
    wide[1:] += RANGE * np.cumsum(turned, dtype=np.int32)
    return wide


def turns(values: AnyArray) -> AnyArray:
    """Return how often each row of ``values`` (time, …) wrapped around since the row before: 1, 0 or -1, (time - 1, …).

    The counts are of a type that holds their differences.

    >>> turns(np.array([65_535, 4, 65_534])).tolist()
    [1, -1]
    """
    jumps = np.diff(values, axis=0)
    return (jumps < -HALF).astype(np.int32) - (jumps > HALF)
