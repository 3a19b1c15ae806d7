"""An assignment of dots to a lattice keeps the order of neighbours, whatever positions are expected."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.arrays import Floats
from tacpipe.video.lattice import order_dots
from tests.video import gels

ROWS, COLUMNS = 7, 9
CENTRE_PX = np.array([gels.WIDTH / 2, gels.HEIGHT / 2])


def corner_areas(positions: Floats) -> Floats:
    """Return twice the signed areas (corner, row, column) of the triangles at the four corners of each cell."""
    cells = positions.reshape(ROWS, COLUMNS, 2)
    corners = [cells[:-1, :-1], cells[:-1, 1:], cells[1:, 1:], cells[1:, :-1]]
    areas = []
    for number, corner in enumerate(corners):
        after, before = corners[(number + 1) % 4] - corner, corners[number - 1] - corner
        areas.append(after[..., 0] * before[..., 1] - after[..., 1] * before[..., 0])
    return np.array(areas)


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    hidden=st.integers(0, 40),
    false_dots=st.integers(0, 40),
    spread_px=st.sampled_from([1.0, 8.0, 20.0, 60.0]),
    depth=st.floats(0, 1),
)
def test_no_cell_flips_and_no_dot_belongs_to_two_markers_whatever_is_expected(
    seed: int, hidden: int, false_dots: int, spread_px: float, depth: float
) -> None:
    rng = np.random.default_rng(seed)
    places = gels.places(ROWS, COLUMNS)
    lattice = order_dots(places, CENTRE_PX)
    assert lattice is not None and (lattice.rows, lattice.columns) == (ROWS, COLUMNS)
    shown = rng.permutation(gels.press(places, depth))[hidden:]
    dots = np.vstack([shown, rng.uniform(0, gels.WIDTH, (false_dots, 2))])
    assigned, _ = lattice.assign(places + rng.normal(0, spread_px, places.shape), dots)
    completed = lattice.complete(assigned, dots)
    rebuilt = lattice.rebuild(completed, dots)
    for candidate in (assigned, completed, rebuilt):
        found = candidate[candidate >= 0]
        assert len(np.unique(found)) == len(found)
        positions = np.where((candidate >= 0)[:, None], dots[candidate], np.nan)
        assert not (corner_areas(positions) <= 0).any()
    assert (rebuilt >= 0).sum() >= (completed >= 0).sum() >= (assigned >= 0).sum()


@settings(max_examples=60, deadline=None)
@given(
    row=st.integers(0, ROWS - 1),
    first=st.integers(1, COLUMNS - 2),
    height=st.integers(1, 3),
    shift=st.sampled_from([-1, 1]),
)
def test_markers_that_are_expected_one_column_off_get_their_own_dots(
    row: int, first: int, height: int, shift: int
) -> None:
    places = gels.places(ROWS, COLUMNS)
    lattice = order_dots(places, CENTRE_PX)
    assert lattice is not None
    expected = places.reshape(ROWS, COLUMNS, 2).copy()
    expected[row : row + height, first:-1] += np.array([shift * gels.PITCH_PX, 0])
    assigned, _ = lattice.assign(expected.reshape(-1, 2), places)
    assert lattice.rebuild(lattice.complete(assigned, places), places).tolist() == list(range(ROWS * COLUMNS))
