"""Markers of drawn gels are found, ordered and tracked to within 0.2 px of where they were drawn, or are missing."""

from collections.abc import Iterable
from functools import cache
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.arrays import Bytes, Floats
from tacpipe.video.lattice import order_dots
from tacpipe.video.markers import GridSearch, MarkerGrid, MarkerTracker, Polarity, detect
from tests.video import gels
from tests.video.gels import ERROR_PX, HEIGHT, PITCH_PX, WIDTH

CENTRE_PX = np.array([WIDTH / 2, HEIGHT / 2])
LONGEST = 10  # frames for which a marker may be mistaken for another
DEPTHS = 6  # drawn depths of a press
POLARITIES: tuple[Literal["dark", "light"], ...] = ("dark", "light")
Disturbance = Literal["grey", "black", "glare", "noise", "bright"]


def grey(places_px: Floats, seed: int = 0, polarity: Polarity = "dark") -> Bytes:
    image: Bytes = np.ascontiguousarray(gels.image(places_px, seed)[..., 0])
    return 255 - image if polarity == "light" else image


def grid_of(image: Bytes, rows: int = 4, columns: int = 6, polarity: Polarity = "auto") -> MarkerGrid:
    grid = GridSearch(rows, columns, polarity, 1).add(image)
    assert grid is not None
    return grid


def follow(images: Iterable[Bytes], grid: MarkerGrid) -> Floats:
    """Return the positions in each image (time, marker, xy)."""
    tracker = MarkerTracker(grid)
    return np.array([tracker.step(image) for image in images])


@pytest.mark.parametrize("polarity", POLARITIES)
def test_dots_are_detected_where_they_were_drawn_and_those_at_the_border_are_left_out(polarity: Polarity) -> None:
    places = np.vstack([gels.places(5, 7), [[1.0, 100.0]]])
    detections = detect(grey(places, polarity=polarity), is_light=polarity == "light")
    assert len(detections) == 35
    distances = np.linalg.norm(detections[:, None] - places[:35], axis=2)
    assert distances.min(axis=0).max() < ERROR_PX


@settings(max_examples=12, deadline=None)
@given(angle_deg=st.floats(-20, 20), absent=st.integers(0, 23), polarity=st.sampled_from(POLARITIES))
def test_a_turned_grid_is_ordered_row_by_row_and_an_absent_marker_is_nan(
    angle_deg: float, absent: int, polarity: Polarity
) -> None:
    places = gels.places(4, 6, angle_deg)
    grid = grid_of(grey(np.delete(places, absent, axis=0), polarity=polarity))
    assert grid.is_light == (polarity == "light")
    assert np.flatnonzero(~grid.exists).tolist() == [absent]
    errors = np.linalg.norm(np.delete(grid.positions_px - places, absent, axis=0), axis=1)
    assert errors.max() < ERROR_PX
    assert grid.pitch_px == pytest.approx(PITCH_PX, abs=0.3)


def test_of_a_larger_grid_the_part_next_to_the_centre_is_taken() -> None:
    places = gels.places(7, 9).reshape(7, 9, 2)
    grid = grid_of(grey(places.reshape(-1, 2)), 3, 5)
    assert np.abs(grid.positions_px - places[2:5, 2:7].reshape(-1, 2)).max() < ERROR_PX


@settings(deadline=None)
@given(angle_deg=st.floats(-8, 8), seed=st.integers(0, 99))
def test_a_hexagonal_layout_is_a_lattice_whose_columns_run_to_the_lower_right(angle_deg: float, seed: int) -> None:
    axial = np.array([(q, r) for r in range(-6, 7) for q in range(-6, 7) if abs(q + r) <= 6])  # 127 pins
    angle = np.deg2rad(angle_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    places = axial @ np.array([[1, 0], [0.5, np.sqrt(0.75)]]) @ turn.T * 16 + CENTRE_PX
    moved = places + np.random.default_rng(seed).normal(0, 0.2, places.shape)
    lattice = order_dots(moved, CENTRE_PX)
    assert lattice is not None
    assert (lattice.rows, lattice.columns) == (13, 13)
    assert np.array_equal(lattice.rest_px.reshape(13, 13, 2)[axial[:, 1] + 6, axial[:, 0] + 6], moved)


def test_displacements_up_to_half_the_pitch_have_errors_below_a_fifth_of_a_pixel() -> None:
    places = gels.places(7, 9)
    grid = grid_of(grey(places))
    # drawn marker of each tracked one
    numbers = np.linalg.norm(grid.positions_px[:, None] - places, axis=2).argmin(axis=1)
    pressed = [gels.press(places, float(depth)) for depth in [*np.linspace(0, 1, 12), *np.linspace(1, 0, 6)]]
    moved = follow((grey(true, frame + 1) for frame, true in enumerate(pressed)), grid) - grid.positions_px
    true = np.array(pressed)[:, numbers] - places[numbers]
    assert np.abs(moved - true).max() < ERROR_PX
    assert np.linalg.norm(true, axis=2).max() == pytest.approx(PITCH_PX / 2, rel=0.15)


@cache
def drawn(depth: int, polarity: Polarity) -> tuple[Floats, Bytes]:
    """Return where markers were drawn (marker, xy), and the image."""
    places = gels.press(gels.places(), depth / (DEPTHS - 1))
    return places, grey(places, depth, polarity)


def disturbed(image: Bytes, kind: Disturbance, area: tuple[int, int, int, int], seed: int) -> Bytes:
    """Return an image with a disturbance in an area (top, bottom, left, right)."""
    top, bottom, left, right = area
    rng = np.random.default_rng(seed)
    changed = image.copy()
    part = changed[top:bottom, left:right]
    y, x = np.indices(part.shape)
    if kind == "noise":  # it covers the complete image
        return rng.integers(0, 256, image.shape).astype(np.uint8)
    if kind == "glare":
        spot = 400 * np.exp(-((x - part.shape[1] / 2) ** 2 + (y - part.shape[0] / 2) ** 2) / (2 * 30.0**2))
        part[:] = np.clip(part + spot, 0, 255)
    else:
        part[:] = {"grey": 128, "black": 0, "bright": 250}[kind] + rng.integers(0, 5, part.shape)
    return changed


@settings(max_examples=60, deadline=None)
@given(
    kind=st.sampled_from(["grey", "black", "glare", "noise", "bright"]),
    polarity=st.sampled_from(POLARITIES),
    area=st.sampled_from(
        [(120, 240, 0, 320), (120, 240, 160, 320), (0, 240, 0, 320), (40, 150, 60, 200), (0, 240, 100, 220)]
    ),
    frames=st.integers(1, 30),
    is_pressed=st.booleans(),
)
def test_markers_keep_their_identity_under_disturbances_or_are_missing_and_all_are_found_again(
    kind: Disturbance, polarity: Polarity, area: tuple[int, int, int, int], frames: int, is_pressed: bool
) -> None:
    depths = [0, 0, *([0, 1, 2, 3, 4, 5, 4, 3, 2, 1] * 3 if is_pressed else [0] * 30)][: frames + 2]
    depths += [*range(depths[-1], 0, -1), 0]
    truth, images = zip(*(drawn(depth, polarity) for depth in depths), strict=True)
    shown = [
        disturbed(image, kind, area, number) if 2 <= number < frames + 2 else image
        for number, image in enumerate(images)
    ]
    grid = grid_of(shown[0], 7, 9, polarity)
    positions = follow(shown, grid)  # (time, marker, xy)
    distances = np.linalg.norm(positions[:, :, None] - np.array(truth)[:, None], axis=3)  # (time, marker, drawn marker)
    is_mistaken = (distances < 0.25 * PITCH_PX) & ~np.eye(63, dtype=bool)
    runs = np.zeros(63, int)
    for mistaken in is_mistaken.any(axis=2):
        runs = np.where(mistaken, runs + 1, 0)
        assert runs.max() <= LONGEST
    assert np.abs(positions[-1] - truth[-1]).max() < ERROR_PX


def test_a_covered_marker_is_missing_and_is_found_again_although_all_have_moved() -> None:
    places = gels.places(4, 6)
    covered = [7, 8]
    images = [grey(np.delete(places + np.array([0.5 * frame, 0]), covered, axis=0), frame) for frame in range(9)]
    positions = follow([*images, grey(places + np.array([4.5, 0]))], grid_of(grey(places)))
    assert np.isnan(positions[:-1, covered]).all()
    assert np.count_nonzero(np.isnan(positions[..., 0])) == 9 * len(covered)
    assert np.abs(positions[-1] - places - [4.5, 0]).max() < ERROR_PX


def test_the_first_frame_with_all_markers_is_the_reference_or_else_the_one_with_most() -> None:
    places = gels.places(4, 6)
    full, partial, dark = grey(places), grey(places[:20]), np.zeros((HEIGHT, WIDTH), np.uint8)
    search = GridSearch(4, 6, "auto", 4)
    assert search.add(dark) is search.add(None) is search.add(partial) is None
    assert (grid := search.add(full)) is not None and grid.exists.all()
    search = GridSearch(4, 6, "auto", 3)
    assert search.add(dark) is search.add(partial) is None
    assert (grid := search.add(dark)) is not None and grid.exists.sum() == 20
    search = GridSearch(4, 6, "light", 1)
    assert search.add(full) is None and search.frames_left == 0
