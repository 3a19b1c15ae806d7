"""Windows with the frames of cameras: which frame a row has, parts, sizes and differences, and loaders with workers."""

import numpy as np
import pytest
import torch

import tacpipe
from tacpipe.datasets.dataset import Dataset
from tests.conftest import Lab
from tests.video import videos

LAYOUT = """
[streams.skin]
files = "{trial}/skin.csv"
time = { column = "t", origin = "start" }
columns = [{ match = "taxel01_x", quantity = "tactile", unit = "count", type = "uint16" }]
[streams.gel]
files = "{trial}/gel.mp4"
"""
RATE_HZ, ROWS, FRAMES = 50, 100, 30


@pytest.fixture(scope="module", params=["mjpeg", "libx264"])
def gels(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Two recordings of a skin at 50 Hz for 2 s, and of a gel at 25 Hz for 1.2 s."""
    folder = tmp_path_factory.mktemp(request.param)
    for trial in ("a", "b"):
        (folder / "lab" / trial).mkdir(parents=True)
        videos.write(folder / "lab" / trial / "gel.mp4", request.param, FRAMES)
        lines = [f"{row / RATE_HZ},{row}" for row in range(ROWS)]
        (folder / "lab" / trial / "skin.csv").write_text("t,taxel01_x\n" + "\n".join(lines) + "\n")
    (folder / "layout.toml").write_text(LAYOUT)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        tacpipe.run("ingest table", "lab", layout="layout.toml", output="r")
        return tacpipe.open("r")


def frames_of(gels: Dataset, recording: str) -> dict[int, np.ndarray]:
    """All frames of a recording, by the reader that tests of videos compare with PyAV."""
    from tacpipe.video.frames import read_frames

    return read_frames(gels[recording].columns("gel"), range(FRAMES))


def test_each_row_has_the_newest_frame_and_rows_after_the_last_frame_are_in_no_window(gels: Dataset) -> None:
    windows = gels.windows(3, 1, stream="skin", images=["gel"])
    frames = frames_of(gels, "b")
    row_ns, frame_ns = (gels["b"].table(name, ["t_ns"])["t_ns"].to_pylist() for name in ("skin", "gel"))
    newest = [max((n for n in range(FRAMES) if frame_ns[n] <= t_ns), default=-1) for t_ns in row_ns]
    usable = [n >= 0 and t_ns - frame_ns[n] <= 120_000_000 for t_ns, n in zip(row_ns, newest, strict=True)]
    starts = [row for row in range(ROWS - 3) if all(usable[row : row + 4])]
    assert 50 < len(starts) < 70 and len(windows) == 2 * len(starts)
    for number in (-1, 0, 40, 7, 8):
        window, rows = windows[len(starts) + number % len(starts)], range(starts[number], starts[number] + 3)
        assert window["past"][:, 0].tolist() == list(rows) and window["images"]["gel"].dtype == torch.uint8
        expected = np.stack([frames[newest[row]] for row in rows])
        assert np.array_equal(window["images"]["gel"].permute(0, 2, 3, 1), expected)


def test_a_loader_with_workers_gives_frames_and_channels_in_any_order(gels: Dataset) -> None:
    windows = gels.windows(2, 1, stream="skin", images=["gel"], size=16)
    expected = {(window["recording"], int(window["t_ns"][0])): window["images"]["gel"] for window in windows}  # type: ignore[attr-defined]
    loader = torch.utils.data.DataLoader(windows, batch_size=7, shuffle=True, num_workers=2)
    count = 0
    for batch in loader:
        assert batch["images"]["gel"].shape[1:] == (2, 3, 16, 16)
        for name, t_ns, images in zip(
            batch["recording"], batch["t_ns"][:, 0].tolist(), batch["images"]["gel"], strict=True
        ):
            assert torch.equal(images, expected[name, t_ns])
            count += 1
    assert count == len(windows)


def test_a_part_of_the_frame_is_cut_before_it_is_scaled(gels: Dataset) -> None:
    part = gels.windows(1, 0, stream="gel", images=["gel"], roi=(4, 2, 20, 10))
    frames = frames_of(gels, "a")
    assert len(part) == 2 * FRAMES and part[0]["past"].shape == (1, 0)
    assert np.array_equal(part[9]["images"]["gel"][0].permute(1, 2, 0), frames[9][2:12, 4:24])
    scaled = gels.windows(1, 0, stream="gel", images=["gel"], roi=(4, 2, 20, 10), size=(5, 10))
    halves = frames[9][2:12, 4:24].reshape(5, 2, 10, 2, 3).mean(axis=(1, 3))
    assert np.abs(scaled[9]["images"]["gel"][0].permute(1, 2, 0).numpy() - halves).mean() < 12


def test_a_difference_is_from_the_mean_of_the_first_five_frames_and_begins_at_the_fifth(gels: Dataset) -> None:
    windows = gels.windows(1, 0, stream="gel", images=["gel"], difference=True)
    frames = frames_of(gels, "a")
    untouched = np.mean([frames[row] for row in range(5)], axis=0)
    assert len(windows) == 2 * (FRAMES - 4)
    image = windows[0]["images"]["gel"]
    assert image.dtype == torch.float32
    assert np.allclose(image[0].permute(1, 2, 0), frames[4] - untouched, atol=1e-3)


def test_a_transform_changes_the_images_of_a_window(gels: Dataset) -> None:
    windows = gels.windows(
        2, 1, stream="skin", images=["gel"], transform=lambda images: images.float().mean(dim=(2, 3))
    )
    assert windows[3]["images"]["gel"].shape == (2, 3)


def test_cameras_of_another_dataset_are_found_by_the_names_of_recordings(
    gels: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert gels.path is not None
    monkeypatch.chdir(gels.path.parent)
    with pytest.warns(tacpipe.ResultWarning, match="gel 60"):
        synchronized = tacpipe.run("synchronize", "r", output="s")
    windows = synchronized.windows(2, 1, images=["gel"], cameras=gels)
    assert windows[0]["images"]["gel"].shape == (2, 3, videos.HEIGHT, videos.WIDTH)
    with pytest.raises(tacpipe.UsageError, match=r"no stream of frames gel.*cameras="):
        len(synchronized.windows(2, 1, images=["gel"]))


def test_a_damaged_frame_is_in_no_window(lab: Lab) -> None:
    place = lab.folder / "lab" / "a"
    place.mkdir(parents=True)
    path = videos.write(place / "gel.avi", "mjpeg", FRAMES)
    content = bytearray(path.read_bytes())
    starts = [at for at in range(len(content) - 3) if content[at : at + 3] == b"\xff\xd8\xff"]
    middle = (starts[12] + starts[13]) // 2
    content[middle : middle + 80] = bytes(80)  # a lost block in frame 12
    path.write_bytes(content)
    (lab.folder / "layout.toml").write_text('[streams.gel]\nfiles = "{trial}/gel.avi"\n')
    lab.run("ingest table lab --layout layout.toml -o r")
    dataset = tacpipe.open(lab.folder / "r")
    damaged = dataset["a"].table("gel")["damaged"].to_numpy()
    windows = dataset.windows(1, 0, stream="gel", images=["gel"])
    assert damaged[12] and len(windows) == FRAMES - damaged.sum()
    t_ns = dataset["a"].table("gel", ["t_ns"])["t_ns"].to_numpy()
    assert [int(window["t_ns"][0]) for window in windows] == t_ns[~damaged].tolist()  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"size": 0}, "size is 0"),
        ({"roi": (0, 0, 0, 5)}, "roi is"),
        ({"images": ["skin"]}, "no stream of frames skin. Its cameras are gel"),
        ({"images": ["palm"]}, "no stream of frames palm"),
        ({"roi": (60, 0, 20, 5)}, "64 x 48"),
    ],
)
def test_wrong_options_are_named(gels: Dataset, options: dict[str, object], message: str) -> None:
    with pytest.raises(tacpipe.UsageError, match=message):
        len(gels.windows(2, 1, **{"stream": "skin", "images": ["gel"], **options}))  # type: ignore[arg-type]
