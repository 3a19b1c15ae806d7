"""RoboSkin slides: made-up blocks in every arrangement, and the published ones where they are at hand."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tacpipe.errors import TacpipeError
from tacpipe.formats.roboskin import Params, discover, is_time, lag_one, roboskin, scramble, unscramble
from tacpipe.plugins.stage import RecordingOutput
from tests.conftest import sample_data
from tests.formats.slide_files import touched, write_roboskin

SAMPLE = sample_data()


def read(source: Path, params: Params | None = None) -> dict[str, RecordingOutput]:
    params = params or Params()
    return {name: roboskin(params, files) for name, files in discover(params, source).items()}


def values(recording: RecordingOutput) -> np.ndarray:
    """Return (triangle, taxel, time)."""
    table = recording.streams["roboskin"]
    return np.stack([column.to_numpy() for column in table.columns[1:]]).reshape(6, 10, table.num_rows)


def test_slides_come_out_as_they_were_felt_though_they_are_published_scrambled(tmp_path: Path) -> None:
    slides = touched()
    write_roboskin(tmp_path, slides)
    result = read(tmp_path)
    assert list(result) == ["roboskin-fold0-000", "roboskin-fold0-001", "roboskin-fold0-002"]
    for recording, slide in zip(result.values(), slides, strict=True):
        np.testing.assert_array_equal(values(recording), slide)
    table = result["roboskin-fold0-001"].streams["roboskin"]
    assert table.column_names[:2] == ["t_ns", "triangle1_taxel01"]
    field = table.schema.field("triangle6_taxel10")
    assert field.type == pa.float32()
    assert field.metadata == {b"unit": b"count", b"quantity": b"tactile", b"triangle": b"6", b"taxel": b"10"}


def test_a_block_that_is_right_already_is_taken_as_it_is(tmp_path: Path) -> None:
    slides = touched()
    np.save(write_roboskin(tmp_path, slides), slides)
    for recording, slide in zip(read(tmp_path).values(), slides, strict=True):
        np.testing.assert_array_equal(values(recording), slide)


def test_the_authors_layout_is_the_published_one_whichever_way_the_block_lies(tmp_path: Path) -> None:
    slides = touched()
    path = write_roboskin(tmp_path, slides)
    for provided in (scramble(slides), slides):
        np.save(path, provided)
        for recording, slide in zip(read(tmp_path, Params(layout="authors")).values(), slides, strict=True):
            np.testing.assert_array_equal(values(recording), scramble(slide))
            assert recording.attributes["layout"] == "authors"


def test_a_slide_that_touched_nothing_is_arranged_as_its_block(tmp_path: Path) -> None:
    slides = touched()
    slides[1] = 0
    slides[1, 3, 4, 40] = 9.0  # one reading says nothing about axes
    write_roboskin(tmp_path, slides)
    np.testing.assert_array_equal(values(read(tmp_path)["roboskin-fold0-001"]), slides[1])


def test_an_array_without_a_time_axis_is_refused(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).uniform(0, 200, (2, 6, 10, 75))
    write_roboskin(tmp_path, noise)
    with pytest.raises(TacpipeError, match="slide 0"):
        read(tmp_path)


def test_stamps_are_made_from_the_nominal_rate_and_say_so(tmp_path: Path) -> None:
    write_roboskin(tmp_path, touched(1))
    table = read(tmp_path, Params(rate_hz=25.0))["roboskin-fold0-000"].streams["roboskin"]
    assert table.column("t_ns").to_pylist() == [40_000_000 * frame for frame in range(75)]
    assert table.schema.field("t_ns").metadata[b"made"] == b"from nominal rate"


@pytest.mark.parametrize(
    ("name", "recording", "part"),
    [
        ("fold_3", "roboskin-fold3-000", {"authors_fold": 3}),
        ("val_1", "roboskin-fold1-000", {"authors_fold": 1}),
        ("test", "roboskin-test-000", {"authors_role": "test"}),
    ],
)
def test_the_block_tells_the_authors_part(tmp_path: Path, name: str, recording: str, part: dict[str, object]) -> None:
    write_roboskin(tmp_path, touched(1), name, np.array([[6]]))
    assert read(tmp_path)[recording].attributes == {
        "sensor": "roboskin",
        "material": 7,
        "trial": 0,
        "session": "roboskin-m07",
        "published": "roboskin",
        "rate_hz": 50.0,
        "layout": "time",
        **part,
    }


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda block: block - 100, "holds values from -.*It looks like 8-bit numbers that wrapped"),
        (lambda block: block * 2, "readings lie from 0 to 255"),
        (lambda block: np.where(block == block.max(), np.nan, block), "holds values that are not finite"),
        (
            lambda block: block[:, :5],
            r"of the shape \(1, 5, 10, 75\); it must hold numbers, and be \(slide, 6 triangles",
        ),
        (lambda block: block[0], r"has the shape \(6, 10, 75\); it must be \(slide, triangle, taxel, time\)"),
        (lambda block: block.astype(object), "cannot be read as an array of numbers.*Copy it again"),
        (lambda block: block > 0, "is an array of bool"),
    ],
)
def test_a_block_that_holds_no_slides_is_refused(tmp_path: Path, change: object, message: str) -> None:
    assert callable(change)
    path = write_roboskin(tmp_path, touched(1))
    np.save(path, change(np.load(path)))
    with pytest.raises(TacpipeError, match=message):
        read(tmp_path)


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        (np.arange(3), "has 3 labels and icub_fold_0.npy 1 slides"),
        (np.array([-1]), r"label 0 is .*-1.*; it must be a whole number from 0"),
        (np.array([1.5]), r"label 0 is .*1\.5.*; it must be a whole number from 0"),
        (np.array([np.nan]), r"label 0 is .*nan.*; it must be a whole number from 0"),
        (np.array(["a"]), r"label 0 is .*'a'.*; it must be a whole number from 0"),
        (np.array([None]), "cannot be read as an array of numbers"),
    ],
)
def test_labels_that_are_none_are_refused(tmp_path: Path, labels: np.ndarray, message: str) -> None:
    write_roboskin(tmp_path, touched(1), labels=labels)
    with pytest.raises(TacpipeError, match=message):
        read(tmp_path)


def test_files_that_are_missing_doubled_or_damaged_are_told(tmp_path: Path) -> None:
    with pytest.raises(TacpipeError, match="holds no block of slides"):
        discover(Params(), tmp_path)
    path = write_roboskin(tmp_path, touched(1))
    with pytest.raises(TacpipeError, match="is not a folder"):
        discover(Params(), path)
    np.save(tmp_path / "icub_val_0.npy", touched(1))
    with pytest.raises(TacpipeError, match="are the same block"):
        discover(Params(), tmp_path)
    (tmp_path / "icub_val_0.npy").unlink()
    (tmp_path / "labels_fold_0.npy").unlink()
    with pytest.raises(TacpipeError, match=r"labels_fold_0\.npy"):
        discover(Params(), tmp_path)
    full = path.read_bytes()
    write_roboskin(tmp_path, touched(1))
    path.write_bytes(full[:2000])
    with pytest.raises(TacpipeError, match="cannot be read as an array of numbers"):
        read(tmp_path)
    path.write_bytes(b"PK\x03\x04 an archive")
    with pytest.raises(TacpipeError, match="it does not begin as an array of numpy does"):
        discover(Params(), tmp_path)


def test_blocks_are_found_at_any_depth_and_copies_below_them_are_passed_over(tmp_path: Path) -> None:
    path = write_roboskin(tmp_path / "set" / "arrays", touched(1))
    write_roboskin(tmp_path / "set" / "arrays" / "copies", touched(2))
    np.save(path.with_name("icub_test_4.npy"), touched(1))
    sources = discover(Params(), tmp_path)
    assert {name: dict(files) for name, files in sources.items()} == {
        "roboskin-fold0-000": {"icub_fold_0.npy[0]": path, "labels_fold_0.npy[0]": path.with_name("labels_fold_0.npy")}
    }


@pytest.mark.data
@pytest.mark.skipif(not (SAMPLE / "roboskin_slide_20_50").is_dir(), reason="the published recordings are not here")
def test_each_published_slide_is_unscrambled_as_the_formula_says() -> None:
    result = read(SAMPLE / "roboskin_slide_20_50")
    assert len(result) == 800
    row, taxel, place = np.indices((6, 10, 75))
    for fold in range(4):
        block = np.load(SAMPLE / "roboskin_slide_20_50" / f"icub_fold_{fold}.npy", allow_pickle=False)
        for slide, published in enumerate(block):
            full = values(result[f"roboskin-fold{fold}-{slide:03d}"])
            mixed = full[(75 * row + place) % 6, taxel, (75 * row + place) // 6]
            np.testing.assert_array_equal(mixed, published)
    materials = [recording.attributes["material"] for recording in result.values()]
    assert np.bincount(np.array(materials, dtype=int)).tolist() == [0, *[40] * 20]


@pytest.mark.data
@pytest.mark.skipif(not (SAMPLE / "roboskin_slide_20_50").is_dir(), reason="the published recordings are not here")
@pytest.mark.parametrize(
    "order", [(0, 3, 1, 2), (0, 3, 2, 1), (0, 1, 3, 2)], ids=["frames first", "mixed", "taxels last"]
)
def test_published_slides_that_went_through_another_wrong_reshape_are_refused(
    tmp_path: Path, order: tuple[int, ...]
) -> None:
    right = unscramble(np.load(SAMPLE / "roboskin_slide_20_50" / "icub_fold_0.npy")[:20])
    path = write_roboskin(tmp_path, right)
    np.save(path, right.transpose(order).reshape(right.shape))
    for files in discover(Params(), tmp_path).values():
        with pytest.raises(TacpipeError, match="neither as it stands nor unscrambled is its last axis time"):
            roboskin(Params(), files)


def walk(seed: int, channels: int = 12, frames: int = 80) -> np.ndarray:
    """Return channels that differ and drift, (channel, time)."""
    rng = np.random.default_rng(seed)
    return rng.normal(0, 5, (channels, 1)) + np.cumsum(rng.normal(size=(channels, frames)), axis=1)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_autocorrelation_is_that_of_neighbours_as_numpy_has_it(axis: int) -> None:
    values = np.cumsum(np.random.default_rng(0).normal(size=(4, 5, 6)), axis=axis)
    moved = np.moveaxis(values, axis, 0)
    expected = np.corrcoef(moved[:-1].ravel(), moved[1:].ravel())[0, 1]
    assert lag_one(values, axis) == pytest.approx(expected)
    assert lag_one(values, axis - 3) == pytest.approx(expected)


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 100), st.floats(-1000, 1000))
def test_neither_unit_nor_offset_changes_it(seed: int, scale: float, offset: float) -> None:
    values = walk(seed)
    assert lag_one(values * scale + offset, 1) == pytest.approx(lag_one(values, 1), abs=1e-6)


@given(st.integers(0, 2**32 - 1))
def test_time_is_the_axis_along_which_readings_drift(seed: int) -> None:
    values = walk(seed)
    assert is_time(values, 1)
    assert is_time(values.T, 0)
    assert not is_time(values, 0)
    assert not is_time(np.random.default_rng(seed).permuted(values, axis=1) - values.mean(axis=1, keepdims=True), 1)


def test_of_two_smooth_axes_the_smoother_is_time() -> None:
    values = np.sin(np.arange(40) / 4)[:, None] + np.sin(np.arange(40) / 9)
    assert 0.5 < lag_one(values, 0) < lag_one(values, 1)
    assert is_time(values, 1)
    assert not is_time(values, 0)


def test_what_does_not_vary_or_is_not_finite_tells_nothing() -> None:
    assert np.isnan(lag_one(np.ones((3, 4)), 1))
    assert np.isnan(lag_one(np.ones((3, 1)), 1))
    assert not is_time(np.ones((3, 4)), 1)
    holed = walk(0)
    holed[2, 3] = np.nan
    assert not is_time(holed, 1)


slides = hnp.arrays(np.float32, hnp.array_shapes(min_dims=3, max_dims=5, max_side=7), elements=st.floats(width=32))


@given(slides)
def test_both_ways_undo_each_other_to_the_bit(given_slides: np.ndarray) -> None:
    for forward, backward in ((scramble, unscramble), (unscramble, scramble)):
        assert backward(forward(given_slides)).tobytes() == np.ascontiguousarray(given_slides).tobytes()
        assert forward(given_slides).shape == given_slides.shape


@given(st.integers(1, 7), st.integers(1, 4), st.integers(1, 9))
def test_each_reading_goes_where_the_formula_says(triangles: int, taxels: int, frames: int) -> None:
    readings = np.random.default_rng(0).random((2, triangles, taxels, frames))
    scrambled = scramble(readings)
    for row in range(triangles):
        for place in range(frames):
            turn = frames * row + place
            assert np.array_equal(scrambled[:, row, :, place], readings[:, turn % triangles, :, turn // triangles])


def test_what_is_scrambled_has_no_time_axis_and_what_is_not_has() -> None:
    for slide in touched(20):
        assert is_time(slide, -1)
        assert not is_time(scramble(slide), -1)
        assert is_time(unscramble(scramble(slide)), -1)
