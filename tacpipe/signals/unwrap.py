"""Counters of few bits that ran over their end."""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import AnyArray


def unwrapped(values: AnyArray) -> AnyArray:
    """Return ``values`` (time,), integers of 16 bits, with wrap-around undone, as int32; as they are where there is none.

    A jump of more than half the range between consecutive samples is one, the other way round the range: no signal that
    is sampled well moves so far. Real uSkin frames jump by 5,000 counts at most.

    >>> unwrapped(np.array([65_530, 65_535, 4, 65_534], dtype=np.uint16)).tolist()
    [65530, 65535, 65540, 65534]
    """
    half = 1 << 15
    if len(values) < 2 or int(values.max()) - int(values.min()) <= half:
        return values
    wide = values.astype(np.int32)
    jumps = np.diff(wide)
    turns = (jumps < -half).astype(np.int32) - (jumps > half)
    if not turns.any():
        return values
    wide[1:] += (1 << 16) * np.cumsum(turns, dtype=np.int32)
    return wide
