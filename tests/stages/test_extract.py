"""Compare channels of cameras, the brightness on a coarse grid, with numpy's on decoded images."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import tacpipe
from tacpipe.arrays import Floats
from tacpipe.channels.places import taxel_positions
from tacpipe.channels.streams import columns_with_quantity
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.plugins.registry import load
from tests.conftest import Lab, forget, write_plugin
from tests.fake_recordings import FakeRecording
from tests.formats import video_files
from tests.stage_params import build_params
from tests.video import gels, videos
from tests.video.test_video_files import columns_of


def differences(frames: pa.Table, **params: Any) -> pa.Table:
    """Return the channels of a stream of frames."""
    return extract({"gel": frames}, **params)["gel"]


def extract(tables: dict[str, pa.Table], name: str = "extract.difference", **params: Any) -> dict[str, pa.Table]:
    """Return what a stage makes of a recording of some streams."""
    output = load(name).function(build_params(name, **params), FakeRecording(tables))
    return {name: table.read_all() for name, table in output.streams.items()}


def frames_of(path: Path) -> pa.Table:
    """Return the stream of frames of a file."""
    columns = columns_of(path)
    return columns.read(columns.column_names)


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return videos.write(tmp_path_factory.mktemp("gel") / "gel.mkv", "libx264", 150)


def test_cells_are_the_mean_change_of_the_images_since_the_first_ones(video: Path) -> None:
    images = np.array(videos.decoded(video), np.float64)  # (time, height, width, colour)
    table = differences(frames_of(video), rows=5, columns=4, reference_frames=3)
    assert table.num_rows == len(images)
    for row, (top, bottom) in enumerate(((0, 9), (9, 19), (19, 28), (28, 38), (38, 48)), start=1):
        for column in range(1, 5):
            cells = images[:, top:bottom, (column - 1) * 16 : column * 16].mean(axis=(1, 2))  # (time, colour)
            reference = np.array([cells[: min(frame + 1, 3)].mean(axis=0) for frame in range(len(cells))])
            for colour, name in enumerate(("red", "green", "blue")):
                values = table.column(f"taxel{row:02d}{column:02d}_{name}").to_numpy()
                assert np.allclose(values, (cells - reference)[:, colour], atol=1e-4)


def test_without_reference_frames_a_row_is_the_brightness_of_its_frame_alone(video: Path) -> None:
    frames = frames_of(video)
    brightness = differences(frames, reference_frames=0)
    relative = differences(frames, reference_frames=1)
    for name in (name for name in brightness.column_names if name.startswith("taxel")):
        values = brightness[name].to_numpy()
        assert np.allclose(values - values[0], relative[name].to_numpy(), atol=1e-3) and (values >= 0).all()


@settings(max_examples=15, deadline=None)
@given(stop=st.integers(1, 150), reference_frames=st.integers(0, 20))
def test_rows_do_not_change_when_later_frames_are_cut_off(video: Path, stop: int, reference_frames: int) -> None:
    frames = frames_of(video)
    dts = frames.column("dts").to_numpy()
    complete = differences(frames, reference_frames=reference_frames)
    if (dts[:stop].max() > dts[stop:]).any():
        return  # Frames before the cut need one after it to be decoded.
    assert differences(frames.slice(0, stop), reference_frames=reference_frames).equals(complete.slice(0, stop))


def test_other_streams_stay_and_taxels_lie_on_the_grid(lab: Lab) -> None:
    video_files.write_gelsight(lab.folder / "gels")
    assert lab.call("ingest gelsight-slip gels -o data/gels").code == 0
    assert lab.call("extract difference data/gels -o data/difference --columns 4 --rows 3").code == 0
    recording = tacpipe.open(lab.folder / "data/difference")["lemon-1"]
    assert recording.attributes["object"] == "lemon"
    assert list(recording.streams) == ["gel0", "gel2"]
    table = recording.table("gel0")
    assert len(columns_with_quantity(table, "tactile")) == 3 * 4 * 3
    places, unit = taxel_positions(
        [table.schema.field(f"taxel0{row}0{column}_red") for row in (1, 2, 3) for column in (1, 4)]
    )
    assert unit == "grid"
    assert places.tolist() == [[1, -1], [4, -1], [1, -2], [4, -2], [1, -3], [4, -3]]
    skin = pa.table({"t_ns": [0, 10], "x": [1.0, 2.0]})
    frames = tacpipe.open(lab.folder / "data/gels")["lemon-1"].table("gel0")
    assert extract({"skin": skin, "gel": frames})["skin"].equals(skin)


def test_the_channels_are_synchronized_and_segmented_like_those_of_any_skin(lab: Lab) -> None:
    video_files.write_gelsight(lab.folder / "gels")
    for command in (
        "ingest gelsight-slip gels -o data/gels",
        "extract difference data/gels -o data/difference",
        "synchronize data/difference -o data/synced",
        "segment contacts data/synced -o data/segments --pad-s 0.1",
    ):
        result = lab.call(command)
        assert result.code == 0, result.err
    synced = tacpipe.open(lab.folder / "data/synced")["lemon-1"].table()
    assert {"gel0_taxel0101_red", "gel2_taxel0608_blue"} <= set(synced.column_names)


def test_a_recording_without_frames_and_a_grid_that_is_too_fine_are_refused(lab: Lab, video: Path) -> None:
    skin = pa.table({"t_ns": [0], "x": [1.0]})
    with pytest.raises(TacpipeError, match="Recording trial has no stream of frames; its streams are skin"):
        extract({"skin": skin})
    with pytest.raises(TacpipeError, match="64 x 48 pixels, and the grid 8 x 49 cells"):
        differences(frames_of(video), rows=49)
    refused = lab.call("extract difference data/gels -o data/d --rows 200 --columns 200")
    assert refused.code == 2
    assert "more than 10,000" in refused.err


@pytest.fixture(scope="module")
def pressed_gel(tmp_path_factory: pytest.TempPathFactory) -> pa.Table:
    """A gel that is pressed in 15 frames, without loss."""
    places = gels.places()
    images = np.array(
        [gels.image(gels.press(places, depth), frame) for frame, depth in enumerate(np.linspace(0, 1, 15))]
    )
    return frames_of(videos.write_images(tmp_path_factory.mktemp("gel") / "gel.mkv", "ffv1", images))


def test_markers_become_displacements_in_pixels_or_millimetres(pressed_gel: pa.Table) -> None:
    table = extract({"gel": pressed_gel}, "extract.markers", rows=3, columns=5)["gel"]
    assert len(columns_with_quantity(table, "tactile")) == 3 * 5 * 2
    places = gels.places().reshape(7, 9, 2)[2:5, 2:7].reshape(-1, 2)
    expected = gels.press(places, 1.0) - places
    names = [f"taxel{row:02d}{column:02d}" for row in (1, 2, 3) for column in range(1, 6)]
    last = np.array([[table.column(f"{name}_{axis}")[-1].as_py() for axis in "xy"] for name in names])
    assert np.abs(last - expected).max() < 0.2
    assert table.column("detected_ratio").to_pylist() == [1.0] * 15
    field = table.schema.field("taxel0203_x")
    assert field.metadata[b"unit"] == b"px"
    in_mm = extract({"gel": pressed_gel}, "extract.markers", rows=3, columns=5, pitch_mm=1.6)["gel"]
    assert in_mm.schema.field("taxel0203_x").metadata[b"unit"] == b"mm"
    ratio = in_mm.column("taxel0203_x")[-1].as_py() / table.column("taxel0203_x")[-1].as_py()
    assert ratio == pytest.approx(1.6 / gels.PITCH_PX, rel=0.01)


@pytest.mark.parametrize("stop", [1, 2, 8, 14])
def test_displacements_do_not_change_when_later_frames_are_cut_off(pressed_gel: pa.Table, stop: int) -> None:
    complete = extract({"gel": pressed_gel}, "extract.markers")["gel"]
    assert extract({"gel": pressed_gel.slice(0, stop)}, "extract.markers")["gel"].equals(complete.slice(0, stop))


def test_a_marker_that_is_not_there_is_null_and_so_are_the_rows_until_the_reference_is_known(tmp_path: Path) -> None:
    places = np.delete(gels.places(4, 6), 9, axis=0)
    images = np.array([gels.image(places, frame) for frame in range(7)])
    frames = frames_of(videos.write_images(tmp_path / "gel.mkv", "ffv1", images))
    table = extract({"gel": frames}, "extract.markers", reference_frames=3)["gel"]
    nulls = {name: table.column(name).null_count for name in table.column_names if name.startswith("taxel")}
    absent = {"taxel0204_x", "taxel0204_y"}
    assert nulls == {name: 7 if name in absent else 2 for name in nulls}
    assert table.column("detected_ratio").to_pylist() == [0, 0, 1, 1, 1, 1, 1]


def test_light_markers_have_the_displacements_of_dark_ones(tmp_path: Path) -> None:
    places = gels.places()
    images = np.array([gels.image(gels.press(places, depth), frame) for frame, depth in enumerate((0.0, 0.5, 1.0))])
    tables = []
    for name, shown in (("dark", images), ("light", 255 - images)):
        frames = frames_of(videos.write_images(tmp_path / f"{name}.mkv", "ffv1", shown))
        tables.append(extract({"gel": frames}, "extract.markers")["gel"])
        fixed = extract({"gel": frames}, "extract.markers", polarity=name)["gel"]
        assert fixed.equals(tables[-1])
    dark, light = ([table.column(name).to_numpy() for name in table.column_names[2:]] for table in tables)
    assert np.abs(np.array(dark) - light).max() < 0.2


@pytest.mark.parametrize(
    ("places", "sentence"),
    [
        (np.empty((0, 2)), r"no markers are seen in the first frames\. .* extract difference"),
        (
            np.array([[40, 40], [90, 60], [60, 120], [200, 50], [250, 180], [150, 210]]),
            "at most 6 dots .* less than half",
        ),
    ],
)
def test_a_gel_without_markers_and_other_layouts_are_refused_in_a_sentence(
    tmp_path: Path, places: Floats, sentence: str
) -> None:
    frames = frames_of(videos.write_images(tmp_path / "gel.mkv", "ffv1", np.array([gels.image(places)] * 6)))
    with pytest.raises(TacpipeError, match=f"Recording trial, stream gel: {sentence}") as raised:
        extract({"gel": frames}, "extract.markers")
    assert ("extract difference" in str(raised.value)) == (not len(places))


def test_markers_are_found_again_after_dark_frames_and_a_note_states_how_many_rows_lack_them(tmp_path: Path) -> None:
    image = gels.image(gels.places())
    images = np.array([image] * 6)
    images[[0, 2, 3]] = 0
    frames = frames_of(videos.write_images(tmp_path / "gel.mkv", "ffv1", images))
    output = load("extract.markers").function(build_params("extract.markers"), FakeRecording({"gel": frames}))
    ratios = output.streams["gel"].read_all().column("detected_ratio").to_pylist()
    assert ratios == [0, 1, 0, 0, 1, 1]
    assert output.notes == ["Stream gel: fewer than half of the markers are found in 3 of 6 frames."]


@pytest.mark.long
def test_features_follow_from_the_frames_and_the_digest_of_the_weights(lab: Lab) -> None:
    lab.run("simulate gel --trials 4 --duration-s 4 -o gels")
    lab.run("split gels -o split --scheme random --val 0.25 --test 0.25")
    train = "extract autoencoder gels --split split --images 60 --components 5"
    lab.run(f"{train} --epochs 2 -o codes")
    features = tacpipe.open("codes")["trial-000"].table("gel1")
    names = [f"feature{number:02d}" for number in range(1, 6)]
    assert features.column_names == ["t_ns", "seq", *names]
    assert all(features.column(name).type == pa.float32() and features.column(name).null_count == 0 for name in names)
    assert features.column("t_ns").equals(tacpipe.open("gels")["trial-000"].table("gel1").column("t_ns"))

    weights = lab.folder / "weights.safetensors"
    weights.write_bytes(Path("codes/encoder.safetensors").read_bytes())
    encode = "extract encoder gels --weights weights.safetensors -o encoded"
    lab.run(encode)
    assert tacpipe.open("encoded")["trial-000"].table("gel1").equals(features)
    assert "0 ran, 4 reused" in lab.run(encode).err

    lab.run(f"{train} --epochs 2 --seed 7 -o others")
    weights.write_bytes(Path("others/encoder.safetensors").read_bytes())
    assert "4 ran, 0 reused" in lab.run(encode).err
    assert not tacpipe.open("encoded")["trial-000"].table("gel1").equals(features)


CORNER_ENCODER = """
def load(path):
    return lambda images: images.reshape(len(images), -1)[:, :3].astype("float32") + len(images)
"""


def test_an_encoder_gives_a_frame_the_same_features_whatever_follows_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_plugin(
        tmp_path, "corner", "[tacpipe.encoders]\ncorner = corner_encoder:load\n", corner_encoder=CORNER_ENCODER
    )
    monkeypatch.syspath_prepend(tmp_path)
    forget()
    weights = tmp_path / "weights"
    weights.write_bytes(b"any")
    frames = frames_of(videos.write(tmp_path / "gel.avi", "mjpeg", 40))
    features = extract({"gel": frames}, "extract.encoder", weights=str(weights), encoder="corner")["gel"]
    images = videos.decoded(tmp_path / "gel.avi")
    expected = np.array([image.reshape(-1)[:3] for image in images], np.float32) + 32
    assert np.array_equal(np.column_stack([features.column(f"feature{n:02d}").to_numpy() for n in (1, 2, 3)]), expected)
    part = extract({"gel": frames.slice(0, 33)}, "extract.encoder", weights=str(weights), encoder="corner")["gel"]
    assert part.equals(features.slice(0, 33))

    options = {"weights": str(weights), "encoder": "corner", "reference_frames": 2}
    changes = extract({"gel": frames}, "extract.encoder", **options)["gel"]
    corners = np.array([image.reshape(-1)[:3] for image in images], np.float64)
    untouched = np.array([corners[: min(row + 1, 2)].mean(axis=0) for row in range(len(corners))])
    expected = np.clip(np.rint(corners - untouched) + 128, 0, 255) + 32
    assert np.array_equal(np.column_stack([changes.column(f"feature{n:02d}").to_numpy() for n in (1, 2, 3)]), expected)
    forget()


def test_weights_that_are_missing_or_changed_are_refused(tmp_path: Path) -> None:
    frames = frames_of(videos.write(tmp_path / "gel.avi", "mjpeg", 4, size=2))
    with pytest.raises(UsageError, match="weights names no file"):
        extract({"gel": frames}, "extract.encoder")
    with pytest.raises(UsageError, match="cannot be read"):
        build_params("extract.encoder", weights=str(tmp_path / "absent"))
    path = tmp_path / "weights"
    path.write_bytes(b"none")
    with pytest.raises(UsageError, match="Give the file that was used before"):
        build_params("extract.encoder", weights=str(path), weights_sha256="0" * 64)
    with pytest.raises(TacpipeError, match="The weights do not fit this autoencoder"):
        extract({"gel": frames}, "extract.encoder", weights=str(path))
    with pytest.raises(UsageError, match="There is no encoder sparsh"):
        extract({"gel": frames}, "extract.encoder", weights=str(path), encoder="sparsh")
