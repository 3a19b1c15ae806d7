"""The arrangement in which slides of a triangular skin were published, and the way back.

Each slide was written as (taxel, time, triangle) and then read as (triangle, taxel, time) without moving its axes, so that
what is called time holds all triangles by turns: ``X[r, c, j] = U[(T r + j) mod 6, c, floor((T r + j) / 6)]`` for slides of
T frames and 6 triangles, where U is the slide as it was measured. Values change places only, so the way back is exact.
"""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import AnyArray


def scramble(slides: AnyArray) -> AnyArray:
    """Return ``slides`` (…, triangle, taxel, time) in the published arrangement, of the same shape.

    >>> measured = np.array([[[0, 1, 2, 3]], [[10, 11, 12, 13]]])  # (triangle, taxel, time)
    >>> scramble(measured).tolist()
    [[[0, 10, 1, 11]], [[2, 12, 3, 13]]]
    """
    triangles, taxels, frames = slides.shape[-3:]
    in_turn = np.moveaxis(slides, -3, -1)  # (…, taxel, time, triangle)
    rows = in_turn.reshape(*slides.shape[:-3], taxels, triangles, frames)
    return np.ascontiguousarray(np.swapaxes(rows, -3, -2))


def unscramble(published: AnyArray) -> AnyArray:
    """Return slides as they were measured, (…, triangle, taxel, time), from the published arrangement; undoes `scramble`.

    >>> unscramble(np.array([[[0, 10, 1, 11]], [[2, 12, 3, 13]]])).tolist()
    [[[0, 1, 2, 3]], [[10, 11, 12, 13]]]
    """
    triangles, taxels, frames = published.shape[-3:]
    rows = np.swapaxes(published, -3, -2)  # (…, taxel, row, place in the row)
    in_turn = rows.reshape(*published.shape[:-3], taxels, frames, triangles)
    return np.ascontiguousarray(np.moveaxis(in_turn, -1, -3))
