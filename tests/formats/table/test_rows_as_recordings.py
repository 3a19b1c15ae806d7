"""A table of which each row is a recording, with its labels and the files that it names."""

from pathlib import Path

import pytest

import tacpipe
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.formats.table import layout, recordings
from tests.conftest import Lab
from tests.formats.table.test_cameras import write_images

TABLE = """\
object,slipped,row,e1,e2
pringles,0,9,100,200
mug,1,8,101,201
mug,,7,102,202
"""
LAYOUT = """\
[recordings]
per_row = "reading"
labels = ["object", "slipped"]
[streams.reading]
files = "{hand}.csv"
columns = [
  { match = "e{electrode}", name = "electrode{electrode}", quantity = "tactile", unit = "count", type = "uint16" },
  { match = "row", quantity = "label" },
]
"""
PRESSES = """\
[recordings]
name = "press-{recording}"
per_row = "pose"
[streams.pose]
files = "targets.csv"
columns = [{ match = "depth", quantity = "position", unit = "mm" }]
[streams.gel]
files = "images/{image}"
format = "images"
"""


def write(folder: Path, content: str = TABLE, text: str = LAYOUT) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "palm.csv").write_text(content)
    (folder.parent / "layout.toml").write_text(text)
    return folder


def sources(folder: Path, text: str = LAYOUT) -> list[recordings.RecordingFiles]:
    return recordings.find_recordings(layout.parse_layout(text), folder)


def test_each_row_is_a_recording_with_its_labels(lab: Lab) -> None:
    write(lab.folder / "lab")
    lab.run("ingest table lab --layout layout.toml -o data/grasps")
    grasps = list(tacpipe.open(lab.folder / "data/grasps"))
    assert [grasp.name for grasp in grasps] == ["palm-1", "palm-2", "palm-3"]
    assert [dict(grasp.attributes) for grasp in grasps] == [
        {"hand": "palm", "object": "pringles", "slipped": 0},
        {"hand": "palm", "object": "mug", "slipped": 1},
        {"hand": "palm", "object": "mug"},  # an empty cell is no label
    ]
    for number, grasp in enumerate(grasps):
        table = grasp.columns("reading").read(["t_ns", "electrode1", "electrode2", "row"])
        assert table.to_pylist() == [
            {"t_ns": 0, "electrode1": 100 + number, "electrode2": 200 + number, "row": 9 - number}
        ]
    lab.run("split data/grasps --group object --val 0 --test 0.5 -o data/split")


def test_names_have_as_many_digits_as_the_last_row(tmp_path: Path) -> None:
    rows = "".join(f"mug,0,1,{row},2\n" for row in range(12))
    names = [source.name for source in sources(write(tmp_path / "lab", f"object,slipped,row,e1,e2\n{rows}"))]
    assert names == [f"palm-{row:02d}" for row in range(1, 13)]


def test_a_row_without_a_time_is_at_0_and_one_with_a_time_at_that(lab: Lab) -> None:
    text = LAYOUT.replace('  { match = "row", quantity = "label" },\n', "").replace(
        'files = "{hand}.csv"', 'files = "{hand}.csv"\ntime = { column = "row", unit = "s", origin = "start" }'
    )
    write(lab.folder / "lab", text=text)
    lab.run("ingest table lab --layout layout.toml -o data/grasps")
    times = [grasp.columns("reading").column("t_ns").to_pylist() for grasp in tacpipe.open(lab.folder / "data/grasps")]
    assert times == [[9 * 10**9], [8 * 10**9], [7 * 10**9]]


def test_a_row_names_the_image_of_its_recording(lab: Lab) -> None:
    folder = lab.folder / "lab"
    contents = write_images(folder / "images", "png", "png", ["a", "b"])
    (folder / "targets.csv").write_text("image,depth\nb.png,1.5\na.png,2.5\n")
    (lab.folder / "layout.toml").write_text(PRESSES)
    lab.run("ingest table lab --layout layout.toml -o data/presses")
    presses = list(tacpipe.open(lab.folder / "data/presses"))
    assert [press.name for press in presses] == ["press-1", "press-2"]
    assert [press.columns("gel").column("packet").to_pylist() for press in presses] == [contents[1:], contents[:1]]
    for press in presses:
        times = [press.columns(stream).column("t_ns").to_pylist() for stream in ("gel", "pose")]
        assert times == [[0], [0]]
        assert not dict(press.attributes)
    (folder / "images" / "a.png").unlink()
    refused = lab.call("ingest table lab --layout layout.toml -o data/lacking")
    assert refused.code == 2
    assert "targets.csv, row 2, names" in refused.err and "a.png" in refused.err


def test_a_preview_shows_the_recordings_of_the_rows(lab: Lab) -> None:
    write(lab.folder / "lab")
    text = lab.run("ingest table lab --layout layout.toml --dry-run").out
    assert "3 recordings: palm-1, palm-2, palm-3" in text
    assert "electrode1, electrode2" in text


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('per_row = "reading"', "", "labels are columns of the stream that per_row names"),
        ('per_row = "reading"', 'per_row = "skin"', "per_row is 'skin'; it must be one of the streams reading"),
        ('files = "{hand}.csv"', 'files = "{hand}.csv"\nformat = "images"', "columns is for tables"),
        ('files = "{hand}.csv"', 'files = "{hand}.csv"\nrecording = "row"', "and reading is none"),
        (
            'files = "{hand}.csv"',
            'files = "{hand}.csv"\ntime = { column = "row", sort = true }',
            "so its time is a column",
        ),
        ('per_row = "reading"', 'per_rows = "reading"', "per_rows"),
    ],
)
def test_rows_that_cannot_be_recordings_are_refused(old: str, new: str, words: str) -> None:
    with pytest.raises(UsageError) as error:
        layout.parse_layout(LAYOUT.replace(old, new))
    assert words in str(error.value)


def test_a_label_that_the_table_lacks_is_named(tmp_path: Path) -> None:
    with pytest.raises(TacpipeError, match=r"palm.csv has no column mass, which \[recordings\]"):
        sources(write(tmp_path / "lab"), LAYOUT.replace('"slipped"]', '"slipped", "mass"]'))
