"""The BioTac SP: electrodes in their place, columns of a reading, and ranges."""

from __future__ import annotations

import numpy as np
import pytest

from tacpipe.channels import biotac_sp


def test_electrodes_lie_on_the_pad_and_mirror_each_other() -> None:
    places = biotac_sp.electrode_positions_m()
    assert places.shape == (24, 3)
    np.testing.assert_array_equal(places[:10] * (1, 1, -1), places[10:20])
    assert (places[:10, 2] > 0).all()
    assert (places[:, 1] < 0).all()
    np.testing.assert_allclose(
        places[0], [9.81456e-3, -2.7686e-3, 3.98526e-3], rtol=1e-6
    )  # 0.3864, -0.1090, 0.1569 inch
    np.testing.assert_allclose(places[23], [1.91262e-3, -7.57174e-3, 0], rtol=1e-6)  # 0.0753, -0.2981, 0 inch
    assert (np.linalg.norm(places, axis=1) < 0.012).all()


def test_electrodes_are_unrolled_in_their_order_along_the_finger_and_mirrored_across_it() -> None:
    flat = biotac_sp.unrolled_positions_m()
    np.testing.assert_array_equal(flat[:, 0], biotac_sp.electrode_positions_m()[:, 0])
    np.testing.assert_allclose(flat[:10, 1], -flat[10:20, 1])
    assert (flat[:10, 1] > biotac_sp.electrode_positions_m()[:10, 2]).all()  # an arc is longer than its shadow
    assert flat[20, 1] == flat[23, 1] == 0
    # electrode 1 lies 0.1090 and 0.1569 inch from the axis: 0.191049 inch at 55.211 degrees from the pad's midline
    assert flat[0, 1] == pytest.approx(0.191049 * np.radians(55.211) * 0.0254, rel=1e-4)


def test_columns_of_a_reading_stand_where_the_published_files_have_them() -> None:
    fields = biotac_sp.fields()
    names = ["", *(field.name for field in fields)]  # a file begins with an empty field
    assert len(fields) == 58
    assert [names[at] for at in (1, 24, 27, 30, 53, 56)] == [
        *("mf_electrode01", "mf_electrode24", "mf_pdc", "th_electrode01", "th_electrode24", "th_pdc"),
    ]
    assert {str(field.type) for field in fields} == {"uint16"}
    assert fields[6].metadata == {b"unit": b"count", b"quantity": b"tactile", b"finger": b"mf", b"electrode": b"7"}
    assert b"electrode" not in fields[26].metadata


def test_the_four_targets_are_fifty_columns_of_a_reading() -> None:
    columns = [name for target in biotac_sp.TARGETS for name in biotac_sp.columns(target)]
    assert len(set(columns)) == len(columns) == sum(biotac_sp.width(target) for target in biotac_sp.TARGETS) == 50
    assert set(columns) <= {field.name for field in biotac_sp.fields()}


def test_values_told_by_target_have_a_column_each_that_names_target_and_electrode() -> None:
    columns = [name for target in biotac_sp.TARGETS for name in biotac_sp.value_columns(target)]
    assert columns[:4] == ["pdc_th", "pdc_mf", "e_th_01", "e_th_02"]
    assert columns[24:28] == ["e_th_23", "e_th_24", "e_mf_01", "e_mf_02"]
    assert len(columns) == 50 and columns[-1] == "e_mf_24"


@pytest.mark.parametrize(
    ("target", "share", "counts"),
    [("pdc_th", 0.05496, 49), ("pdc_mf", 0.0617, 43), ("e_th", 0.06099, 213), ("e_mf", 0.05922, 195)],
)
def test_errors_of_the_letter_in_shares_are_its_errors_in_counts(target: str, share: float, counts: int) -> None:
    zero, at = biotac_sp.to_counts(target, np.array([0.0, share]))
    assert at - zero == pytest.approx(counts, abs=0.6)
    np.testing.assert_allclose(biotac_sp.normalise(target, np.array([zero, at])), [0, share], atol=1e-12)
    assert biotac_sp.normalise(target, np.array(biotac_sp.RANGES[target])).tolist() == [0, 1]
