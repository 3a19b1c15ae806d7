"""Taxels over time: vectors, level without load, scale of colours."""

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.channels import biotac_sp, schema
from tacpipe.io.parquet import with_metadata
from tacpipe.signals import contact
from tacpipe.traces import taxels
from tests.viewer import hand


def test_the_change_from_rest_is_that_of_each_taxel_and_axis() -> None:
    (touch,) = taxels.taxels_from_table("xela1", hand.finger(hand.pressed()))

    np.testing.assert_array_equal(touch.change, hand.pressed())
    assert (touch.name, touch.unit, touch.names[0], touch.names[-1]) == ("xela1", "count", "taxel01", "taxel16")
    np.testing.assert_allclose(touch.magnitude[-1], np.hypot(30, 100 * np.arange(1, 17)))


def test_the_load_is_the_one_that_contacts_are_segmented_by() -> None:
    values = np.random.default_rng(0).integers(0, 4000, (200, 48)).astype(float)
    table = schema.stream(hand.times(hand.SKIN_HZ), values.T, schema.uskin_fields())

    (touch,) = taxels.taxels_from_table("a", table)

    rest_level = contact.rest_level(values, hand.times(hand.SKIN_HZ), taxels.REST_S)
    np.testing.assert_allclose(touch.load, contact.load(values, rest_level))


def test_the_level_of_the_segmentation_comes_before_the_start_of_the_recording() -> None:
    table = hand.finger(hand.pressed())
    names = [field.name for field in schema.uskin_fields()]
    marked = with_metadata(table, {name: {"rest": "15000.0"} for name in names})

    (touch,) = taxels.taxels_from_table("xela1", marked)

    np.testing.assert_array_equal(touch.change, hand.pressed() + 1000)


def test_axes_that_are_columns_in_another_order_make_the_same_vectors() -> None:
    table = hand.finger(hand.pressed())
    by_axis = sorted(table.column_names[1:], key=lambda name: (name[-1], name))

    (touch,) = taxels.taxels_from_table("xela1", table.select(["t_ns", *by_axis]))

    np.testing.assert_array_equal(touch.change, hand.pressed())


def test_two_fingers_of_one_reading_are_apart_and_keep_their_counts() -> None:
    row = np.arange(58)
    table = schema.stream(np.array([5]), row[:, None], biotac_sp.fields())

    mf, th = taxels.taxels_from_table("reading", table)

    assert (mf.name, th.name) == ("reading mf", "reading th")
    assert (mf.names[0], mf.channels[0]) == ("electrode01", "mf_electrode01")
    np.testing.assert_array_equal(mf.magnitude, [np.arange(24.0)])
    np.testing.assert_array_equal(th.magnitude, [29 + np.arange(24.0)])


@pytest.mark.parametrize(
    "values", [np.zeros(5), np.full(5, np.nan), np.array([]), np.array([-1e9, 1e9, np.nan]), np.full(3, 7.0)]
)
def test_a_scale_always_has_a_width_and_holds_zero_or_the_values(values: np.ndarray) -> None:
    low, high = taxels.scale(values)

    assert low <= high and np.isfinite([low, high]).all()
    assert low <= 0 <= high or low == values.min()


def test_a_stream_without_times_has_no_taxels() -> None:
    field = pa.field("a", pa.int16(), metadata={"quantity": "tactile"})

    assert taxels.taxels_from_table("a", pa.table([pa.array([1], pa.int16())], schema=pa.schema([field]))) == []
