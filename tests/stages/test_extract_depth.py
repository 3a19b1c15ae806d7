"""Compare maps of gels and depths with rendered balls, whose surface is known, and integration with least squares."""

import csv
import json
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import tacpipe
from tacpipe.arrays import Floats
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.live.stages import live_channels
from tacpipe.video.decoding import cell_means
from tacpipe.video.depth import depth_from_normals, integrate
from tacpipe.video.encoding import encode_images, jpeg_format
from tacpipe.video.files import packet_stream
from tacpipe.video.gel_map import GelMap, relative_change
from tacpipe.video.gel_presses import GelFit, Press, fit_presses, fit_radius_mm
from tests.conftest import Lab, sample_data
from tests.stages.test_extract import extract
from tests.video import balls

PRESSES = sample_data() / "gel_presses"


def press(x: float, y: float, diameter_mm: float, stated_mm: float = 0.0, **drawn: Any) -> Press:
    change = relative_change(balls.image(x, y, diameter_mm, **drawn).astype(float), balls.background())
    return Press(stated_mm or diameter_mm, change)


@pytest.fixture(scope="module")
def fit() -> GelFit:
    """A map fitted to rendered presses, an untouched gel, and a ball of another size than is stated."""
    presses = {f"press-{index}": press(*place, seed=index) for index, place in enumerate(balls.PLACES)}
    presses |= {"untouched": press(40, 30, 6.0, share=0.0), "wrong": press(40, 30, 6.0, stated_mm=12.0)}
    return fit_presses(presses, balls.MM_PER_PX)


def gel_map(fit: GelFit) -> GelMap:
    size = (balls.WIDTH, balls.HEIGHT, balls.MM_PER_PX)
    return GelMap(*size, balls.background(), fit.weights, fit.is_covered, fit.max_sine, fit.rim_ratio)


@pytest.fixture(scope="module")
def map_file(fit: GelFit, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("map") / "gel_map.npz"
    path.write_bytes(gel_map(fit).to_bytes())
    return path


@settings(max_examples=30, deadline=None)
@given(
    st.tuples(st.integers(2, 6), st.integers(2, 6), st.just(2)).flatmap(
        lambda shape: arrays(np.float64, shape, elements=st.floats(-3, 3))
    )
)
def test_integration_is_the_least_squares_solution(gradients: Floats) -> None:
    rows, columns, _ = gradients.shape
    cell = np.arange(rows * columns).reshape(rows, columns)
    pairs = [(cell[:, :-1], cell[:, 1:], gradients[..., 0]), (cell[:-1], cell[1:], gradients[..., 1])]
    differences, targets = [], []
    for before, after, gradient in pairs:
        for start, stop in zip(before.ravel(), after.ravel(), strict=True):
            differences.append(np.eye(rows * columns)[stop] - np.eye(rows * columns)[start])
            targets.append((gradient.ravel()[start] + gradient.ravel()[stop]) / 2)
    expected = np.linalg.lstsq(np.array(differences), np.array(targets), rcond=None)[0]
    np.testing.assert_allclose(integrate(gradients).ravel(), expected - expected.mean(), atol=1e-9)


def test_a_map_of_rendered_presses_knows_its_error_and_names_what_it_refuses(fit: GelFit) -> None:
    assert fit.refused == {"untouched": "no contact is seen", "wrong": "its surface is not that of the ball"}
    assert set(fit.errors) == {f"press-{index}" for index in range(len(balls.PLACES))}
    for index, (x, y, diameter_mm) in enumerate(balls.PLACES):
        name = f"press-{index}"
        circle = fit.circles[name]
        assert np.abs(circle[:2] - [x, y]).max() < 0.5
        assert circle[2] * balls.MM_PER_PX == pytest.approx(balls.contact_mm(diameter_mm), abs=0.4)
        error = fit.errors[name]
        assert error.slope_deg < 3
        assert abs(error.radius_mm) < 0.05 * diameter_mm / 2
        assert abs(error.depth_mm) < 0.05


def test_the_depth_of_a_ball_that_was_not_fitted_is_that_of_its_surface(fit: GelFit) -> None:
    x, y, diameter_mm = 30.0, 31.0, 7.5
    normals, is_guess = gel_map(fit).normals(press(x, y, diameter_mm, seed=99).change)
    depth = depth_from_normals(normals, balls.MM_PER_PX)
    distance = balls.distances_mm(x, y)
    expected = balls.depth_mm(distance, diameter_mm)
    assert np.abs(depth - expected + np.median(expected)).max() < 0.06
    is_contact = distance < balls.contact_mm(diameter_mm)
    assert fit_radius_mm(depth, is_contact, balls.MM_PER_PX) == pytest.approx(diameter_mm / 2, rel=0.03)
    assert is_guess[~fit.is_covered].all() and not is_guess[fit.is_covered & ~is_contact].any()


def video(shares: list[float], width_px: int = balls.WIDTH) -> pa.Table:
    """The stream of a camera that looks at a ball; a share of 0 is the untouched gel."""
    images = [balls.image(40, 30, 9.5, share=share, seed=seed)[:, :width_px] for seed, share in enumerate(shares)]
    video_format = jpeg_format(width_px, balls.HEIGHT, None)
    ticks = np.arange(len(images))
    clocks = (ticks, ticks, np.ones(len(images), bool))
    packets = encode_images(video_format, images)
    return packet_stream(video_format, packets, clocks, 40_000_000 * ticks, ticks, None).read_all()


def test_depth_appears_with_the_contact_and_rows_do_not_look_ahead_live_or_offline(map_file: Path) -> None:
    frames = video([0.0] * 5 + [0.5, 1.0, 1.0])
    options = {"map": str(map_file), "rows": 15, "columns": 20}
    table = extract({"gel": frames}, "extract.depth", **options)["gel"]
    deepest = table["deepest"].to_numpy()
    true_mm = float(balls.depth_mm(np.zeros(1), 9.5)[0])
    assert (deepest[:5] < 0.1).all() and deepest[6:] == pytest.approx(true_mm, abs=0.1)
    assert table["contact_area"].to_numpy()[:5].tolist() == [0] * 5
    assert table["contact_area"][-1].as_py() == pytest.approx(np.pi * balls.contact_mm(9.5) ** 2, rel=0.15)
    assert table["deepest_x"].to_pylist()[:5] == [None] * 5
    assert table["deepest_x"][-1].as_py() == pytest.approx(40.5 * balls.MM_PER_PX, abs=0.3)
    assert table["deepest_y"][-1].as_py() == pytest.approx(30.5 * balls.MM_PER_PX, abs=0.3)
    cells = np.array(
        [table[f"taxel{row:02d}{column:02d}"][-1].as_py() for row in range(1, 16) for column in range(1, 21)]
    )
    expected = cell_means(balls.depth_mm(balls.distances_mm(40, 30), 9.5)[..., None], 15, 20).ravel()
    assert np.abs(cells - expected).max() < 0.1
    assert table.schema.field("taxel0203").metadata[b"unit"] == b"mm"

    assert extract({"gel": frames.slice(0, 7)}, "extract.depth", **options)["gel"].equals(table.slice(0, 7))
    step: Any = {"stage": "extract.depth", "version": 1, "params": options, "fitted": None}
    (camera,) = live_channels([step], {"gel": frames.schema}).values()
    live = pa.concat_tables([camera.push(frames.slice(start, 3)) for start in range(0, 8, 3)])
    assert live.schema.equals(table.schema, check_metadata=True)
    for column in table.column_names:
        np.testing.assert_array_equal(live[column].to_numpy(), table[column].to_numpy())


def test_presses_in_a_folder_become_a_map_and_depths(lab: Lab) -> None:
    balls.write_presses(lab.folder)
    lab.run("ingest table presses --layout layout.toml -o data/presses")
    ran = lab.run("extract gel-map data/presses --background background.png --mm-per-px 0.25 -o data/gel")
    assert "with the map of the 11 others: slope " in ran.err and "% of the image" in ran.err
    report = json.loads((lab.folder / "data/gel/errors.json").read_text())
    assert report["refused"] == {} and len(report["presses"]) == 12
    lab.run("extract depth data/presses --map data/gel --reference-frames 0 -o data/depth")
    for name, recording in tacpipe.open(lab.folder / "data/depth").recordings.items():
        x, y, _ = balls.PLACES[int(name.split("-")[1])]
        table = recording.table("gel")
        place = [table[column][0].as_py() / balls.MM_PER_PX - 0.5 for column in ("deepest_x", "deepest_y")]
        assert np.abs(np.array(place) - [x, y]).max() < 2, name
    refused = lab.call("extract gel-map data/presses --mm-per-px 0.25 -o data/other")
    assert refused.code == 1 and "A contact is seen in 0 of 12 presses" in refused.err


def test_wrong_inputs_are_refused_in_a_sentence(map_file: Path, tmp_path: Path) -> None:
    frames = video([0.0, 1.0])
    with pytest.raises(UsageError, match="map names no file"):
        extract({"gel": frames}, "extract.depth")
    with pytest.raises(UsageError, match="the grid 100 x 12"):
        extract({"gel": frames}, "extract.depth", map=str(map_file), columns=100)
    other = tmp_path / "other.npz"
    other.write_bytes(map_file.read_bytes()[:3000])
    with pytest.raises(UsageError, match="is not the map of a gel"):
        extract({"gel": frames}, "extract.depth", map=str(other))
    with pytest.raises(TacpipeError, match="frames have 64 x 60 pixels, and the map was fitted to 80 x 60"):
        extract({"gel": video([0.0, 1.0], width_px=64)}, "extract.depth", map=str(map_file))


@pytest.mark.data
@pytest.mark.skipif(not PRESSES.is_dir(), reason="the published presses are not here")
def test_half_of_the_published_presses_predict_the_balls_of_the_other_half() -> None:
    background = read_cells(PRESSES / "background.png")
    presses = {}
    with (PRESSES / "catalog.csv").open() as file:
        for row in csv.DictReader(file):
            folder = row["experiment_reldir"]
            change = relative_change(read_cells(PRESSES / folder / "gelsight.png"), background)
            presses[folder] = Press(float(row["diameter(mm)"]), change)
    cell_mm = 2 * 0.0634
    every = fit_presses(presses, cell_mm)
    half = fit_presses(dict(list(presses.items())[::2]), cell_mm)
    assert not every.refused and not half.refused
    fitted = GelMap(320, 240, 0.0634, background, half.weights, half.is_covered, half.max_sine, half.rim_ratio)
    errors_mm = []
    for name in list(presses)[1::2]:
        depth = depth_from_normals(fitted.normals(presses[name].change)[0], cell_mm)
        y_cells, x_cells = np.indices(depth.shape)
        x, y, radius = every.circles[name]
        is_inside = np.hypot(x_cells - x, y_cells - y) < radius
        errors_mm.append(fit_radius_mm(depth, is_inside, cell_mm) - presses[name].diameter_mm / 2)
    assert np.sqrt(np.mean(np.square(errors_mm))) < 0.25


def read_cells(path: Path) -> Floats:
    """The colours of an image on the grid of a map."""
    with av.open(str(path)) as container:
        image: Any = next(container.decode(video=0)).to_ndarray(format="rgb24")
    return cell_means(image, 120, 160)
