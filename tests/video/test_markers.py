"""Markers of drawn gels are found, ordered and tracked to within 0.2 px of where they were drawn."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.arrays import Bytes, Floats
from tacpipe.video.markers import UNCONFIRMED_FRAMES, MarkerGrid, MarkerTracker, detect, find_grid
from tests.video import gels
from tests.video.gels import ERROR_PX


def grey(places_px: Floats, seed: int = 0) -> Bytes:
    return np.ascontiguousarray(gels.image(places_px, seed)[..., 0])


def grid_of(image: Bytes, rows: int = 4, columns: int = 6) -> MarkerGrid:
    grid = find_grid(image, rows, columns)
    assert grid is not None
    return grid


def test_dots_are_detected_where_they_were_drawn_and_those_at_the_border_are_left_out() -> None:
    places = np.vstack([gels.places(5, 7), [[1.0, 100.0]]])
    detections = detect(grey(places))
    assert len(detections) == 35
    distances = np.linalg.norm(detections[:, None] - places[:35], axis=2)
    assert distances.min(axis=0).max() < ERROR_PX


@settings(max_examples=12, deadline=None)
@given(angle_deg=st.floats(-20, 20), absent=st.integers(0, 23))
def test_a_turned_grid_is_ordered_row_by_row_and_an_absent_marker_is_nan(angle_deg: float, absent: int) -> None:
    places = gels.places(4, 6, angle_deg)
    grid = grid_of(grey(np.delete(places, absent, axis=0)))
    assert np.flatnonzero(np.isnan(grid.positions_px[:, 0])).tolist() == [absent]
    errors = np.linalg.norm(np.delete(grid.positions_px - places, absent, axis=0), axis=1)
    assert errors.max() < ERROR_PX
    assert grid.pitch_px == pytest.approx(gels.PITCH_PX, abs=0.3)


def test_of_a_larger_grid_the_part_next_to_the_centre_is_taken() -> None:
    places = gels.places(7, 9).reshape(7, 9, 2)
    grid = grid_of(grey(places.reshape(-1, 2)), 3, 5)
    assert np.abs(grid.positions_px - places[2:5, 2:7].reshape(-1, 2)).max() < ERROR_PX


def test_displacements_up_to_half_the_pitch_have_errors_below_a_fifth_of_a_pixel() -> None:
    places = gels.places(7, 9)
    grid = grid_of(grey(places))
    # drawn marker of each tracked one
    numbers = np.linalg.norm(grid.positions_px[:, None] - places, axis=2).argmin(axis=1)
    tracker = MarkerTracker(grid, grey(places))
    largest = 0.0
    for frame, depth in enumerate([*np.linspace(0, 1, 12), *np.linspace(1, 0, 6)]):
        pressed = gels.press(places, float(depth))
        positions, is_detected = tracker.step(grey(pressed, frame + 1))
        assert is_detected.all()
        true = (pressed - places)[numbers]
        assert np.abs(positions - grid.positions_px - true).max() < ERROR_PX
        largest = max(largest, float(np.linalg.norm(true, axis=1).max()))
    assert largest == pytest.approx(gels.PITCH_PX / 2, rel=0.15)


def test_a_covered_marker_is_missing_after_some_frames_and_is_found_again() -> None:
    places = gels.places(4, 6)
    tracker = MarkerTracker(grid_of(grey(places)), grey(places))
    covered = np.array([7, 8])
    for frame in range(UNCONFIRMED_FRAMES + 4):
        shown = np.delete(places + np.array([0.5 * frame, 0]), covered, axis=0)
        positions, is_detected = tracker.step(grey(shown, frame + 1))
        assert not is_detected[covered].any()
        assert is_detected.sum() == 22
    assert np.isnan(positions[covered]).all()
    moved = places + np.array([0.5 * frame, 0])
    positions, is_detected = tracker.step(grey(moved, 99))
    assert is_detected.all()
    assert np.abs(positions - moved).max() < ERROR_PX


def test_an_image_without_markers_has_no_grid() -> None:
    assert find_grid(grey(np.empty((0, 2))), 4, 6) is None
