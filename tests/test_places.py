"""Taxels are placed by layout, by row and column numbers, or on a grid."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from tacpipe.channels import biotac_sp, places, schema


def test_a_xela_uskin_is_a_square_of_four_by_four_in_the_order_of_its_taxels() -> None:
    positions, unit = places.taxel_positions([field for field in schema.uskin_fields() if field.name.endswith("_x")])

    assert unit == "mm" and positions.shape == (16, 2)
    pitch = places.USKIN_PITCH_M * 1e3
    np.testing.assert_allclose(positions[0] - positions[-1], [-3 * pitch, -3 * pitch])
    np.testing.assert_allclose(np.linalg.norm(np.diff(positions[:4], axis=0), axis=1), pitch)


def test_electrodes_lie_by_their_number_whatever_the_order_of_the_columns() -> None:
    fields = [field for field in schema.biotac_fields() if field.name.startswith("electrode")]

    positions, unit = places.taxel_positions(fields)
    turned, _ = places.taxel_positions(fields[::-1])

    assert unit == "mm"
    np.testing.assert_array_equal(positions, turned[::-1])
    assert positions[:, 1].argmax() == 6  # electrode 7 is at the tip, which is at the top
    np.testing.assert_allclose(positions[0], positions[10] * (-1, 1))  # 11 mirrors 1


def test_a_biotac_sp_is_rolled_out_as_its_published_electrodes() -> None:
    fields = [field for field in biotac_sp.fields() if field.name.startswith("th_electrode")]

    positions, _ = places.taxel_positions(fields)

    np.testing.assert_allclose(positions, 1e3 * biotac_sp.unrolled_positions_m()[:, ::-1])


def test_a_roboskin_has_sixty_places_of_its_own() -> None:
    positions, unit = places.taxel_positions(schema.roboskin_fields())

    assert unit == "mm" and len({tuple(position) for position in positions.round(3).tolist()}) == 60


def test_row_and_column_numbers_come_before_any_layout() -> None:
    fields = [
        pa.field(f"t{n}", pa.float32(), metadata={"row": str(n % 2 + 1), "column": str(n // 2 + 1)}) for n in range(6)
    ]

    positions, unit = places.taxel_positions(fields)

    assert unit == "grid"
    np.testing.assert_array_equal(positions[:3], [[1, -1], [1, -2], [2, -1]])


def test_an_unknown_array_is_a_grid_in_which_no_two_taxels_lie_on_one_another() -> None:
    for count in (1, 2, 7, 48, 96):
        positions, unit = places.taxel_positions([pa.field(f"c{n}", pa.int16()) for n in range(count)])
        assert unit == "grid" and len({tuple(position) for position in positions.tolist()}) == count


def test_numbers_beyond_a_known_layout_make_a_grid() -> None:
    fields = [pa.field(f"e{n}", pa.int16(), metadata={"electrode": str(n)}) for n in (1, 2, 40)]

    assert places.taxel_positions(fields)[1] == "grid"
