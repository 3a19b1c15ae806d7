"""Colours, the carpet and the small picture of a notebook."""

import xml.etree.ElementTree as ET

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.traces import curves, drawing, taxels
from tests.viewer import hand


def test_colours_rise_in_brightness_with_the_value_and_are_cut_at_the_ends() -> None:
    colours = drawing.map_colours(np.linspace(-1, 12, 200), 0.0, 10.0).astype(int)
    brightness = colours @ [0.299, 0.587, 0.114]

    assert (np.diff(brightness) > -1).all() and brightness[-1] > 4 * brightness[0]  # numbers are rounded
    np.testing.assert_array_equal(colours[0], drawing.map_colours(np.array(0.0), 0.0, 10.0))
    np.testing.assert_array_equal(colours[-1], drawing.map_colours(np.array(10.0), 0.0, 10.0))


def test_both_signs_differ_and_their_middle_is_the_ground() -> None:
    low, middle, high = drawing.map_colours(np.array([-5.0, 0.0, 5.0]), -5.0, 5.0).astype(int)

    assert low[2] > low[0] and high[0] > high[2]  # blue below, orange above
    np.testing.assert_array_equal(middle, drawing.map_colours(np.array(0.0), 0.0, 5.0))


@given(st.integers(0, 2**32 - 1), st.integers(1, 500), st.integers(1, 60))
def test_each_bin_of_the_carpet_has_the_value_farthest_from_rest(seed: int, rows: int, bins: int) -> None:
    rng = np.random.default_rng(seed)
    t_ns = np.sort(rng.integers(0, 1000, rows))
    values = rng.normal(size=(rows, 2))

    carpet = taxels.bin_peaks(t_ns, values, 0, 1000, bins)

    latest = np.full(2, np.nan)
    filled_bins = np.unique(t_ns * bins // 1000)
    ends = filled_bins[-1] + int(np.median(np.diff(filled_bins))) if len(filled_bins) > 1 else bins
    for place in range(bins):
        inside = values[t_ns * bins // 1000 == place]
        if len(inside):
            latest = inside[np.abs(inside).argmax(axis=0), np.arange(2)]
        if place >= ends:  # the stream has ended
            latest = np.full(2, np.nan)
        np.testing.assert_array_equal(carpet[place], latest)


def test_the_picture_of_a_notebook_is_svg_of_bounded_size_whatever_the_length() -> None:
    skin = taxels.taxels_from_table("xela1", hand.finger(hand.pressed()))
    arm = curves.curves_of_table("<arm>", hand.arm())
    picture = drawing.svg(drawing.picture_rows(arm * 10, skin))

    root = ET.fromstring(picture)
    lines = [element for element in root.iter() if element.tag.endswith("polyline")]
    assert len(picture) < 120_000 and len(lines) <= drawing.MAX_ROWS * drawing.MAX_LINES
    assert all(len(element.attrib["points"].split()) <= drawing.MAX_POINTS for element in lines)
    texts = [element.text or "" for element in root.iter() if element.tag.endswith("text")]
    assert "xela1 touch (count)" in texts and any("<arm>" in element for element in texts)
    assert any("13 more" in element and "3.999 s" in element for element in texts)


def test_there_is_no_picture_of_nothing() -> None:
    assert drawing.svg([]) == ""
