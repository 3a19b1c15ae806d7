"""Grasps as vision2tactile has them: made up, and the published ones where they are at hand."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from scipy.spatial.transform import Rotation

from tacpipe.channels import biotac_sp
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.errors import TacpipeError
from tacpipe.formats.vision2tactile import Params, discover, session, vision2tactile
from tacpipe.plugins.stage import RecordingOutput
from tests.conftest import sample_data
from tests.formats.grasp_files import BEGAN_S, colours, counts, header, packed, points_m, write_grasp
from tests.test_imports import HEAVY, imported

PUBLISHED = sample_data() / "vision2tactile"


def read(source: Path, params: Params | None = None) -> dict[str, RecordingOutput]:
    params = params or Params()
    return {name: vision2tactile(params, files) for name, files in discover(params, source).items()}


def reading(recording: RecordingOutput) -> list[int]:
    (row,) = recording.streams["reading"].drop_columns("t_ns").to_pylist()
    return list(row.values())


def test_a_grasp_has_its_cloud_its_points_and_one_reading_at_its_folders_time(tmp_path: Path) -> None:
    write_grasp(tmp_path)
    ((name, result),) = read(tmp_path).items()
    assert name == "bleach-1561629162"
    marked = {"session": "bleach-2019-06-27", "published": "vision2tactile"}
    assert result.attributes == {"sensor": "biotac-sp", "object": "bleach", **marked}
    assert set(result.streams) == {"cloud", "grasp", "reading"}
    cloud = Cloud.from_table(result.streams["cloud"])
    np.testing.assert_array_equal(cloud.points_m, points_m())
    np.testing.assert_array_equal(np.asarray(cloud.colours), colours())
    grasp = Grasp.from_table(result.streams["grasp"])
    np.testing.assert_allclose([grasp.g1_m, grasp.g2_m], points_m()[:2], rtol=1e-6)
    assert grasp.wrist is None
    for stream in ("grasp", "reading"):
        assert result.streams[stream].column("t_ns").to_pylist() == [1_561_629_162_000_000_000]


def test_the_reading_is_the_middle_finger_then_the_thumb_in_the_files_columns(tmp_path: Path) -> None:
    write_grasp(tmp_path)
    (result,) = read(tmp_path).values()
    table, cells = result.streams["reading"], ["", *counts()]
    assert reading(result) == counts()
    at = {
        "mf_electrode01": 1,
        "mf_electrode24": 24,
        "mf_pac0": 25,
        "mf_pac1": 26,
        "mf_pdc": 27,
        "mf_tac": 28,
        "mf_tdc": 29,
    }
    at |= {"th_electrode01": 30, "th_electrode24": 53, "th_pdc": 56, "th_tdc": 58}
    assert {name: table.column(name)[0].as_py() for name in at} == {name: cells[place] for name, place in at.items()}
    assert table.schema.field("th_pdc").type == pa.uint16()
    assert [len(biotac_sp.columns(target)) for target in biotac_sp.TARGETS] == [1, 1, 24, 24]


def test_a_wrist_is_read_row_by_row_where_the_file_has_fifteen_numbers(tmp_path: Path) -> None:
    path = write_grasp(tmp_path) / "best-grasp.txt"
    wrist = Rotation.from_euler("xyz", [0.3, -0.8, 1.1]).as_matrix()
    path.write_text(path.read_text() + "," + ",".join(f"{value:.6g}" for value in wrist.ravel()) + "\n")
    (result,) = read(tmp_path).values()
    np.testing.assert_allclose(np.asarray(Grasp.from_table(result.streams["grasp"]).wrist), wrist, atol=1e-5)
    path.write_text(",".join(path.read_text().split(",")[:6]) + ",1,0,0,0,1,0,0,0,-1")
    with pytest.raises(TacpipeError, match=r"best-grasp\.txt"):
        read(tmp_path)


def test_a_session_is_an_object_on_a_day_whichever_other_grasps_there_are(tmp_path: Path) -> None:
    write_grasp(tmp_path)
    write_grasp(tmp_path, after_s=3600, seed=1)
    write_grasp(tmp_path, after_s=86_400, seed=2)
    write_grasp(tmp_path, "wood", after_s=60, seed=3)
    result = {name: recording.attributes["session"] for name, recording in read(tmp_path).items()}
    assert list(result.values()) == ["bleach-2019-06-27", "bleach-2019-06-27", "bleach-2019-06-28", "wood-2019-06-27"]
    assert read(tmp_path / "wood" / str(BEGAN_S + 60))["wood-1561629222"].attributes["session"] == "wood-2019-06-27"


def test_a_reading_that_an_earlier_grasp_has_too_is_marked_and_kept(tmp_path: Path) -> None:
    write_grasp(tmp_path, "wood", after_s=50, seed=0, reading=7)
    write_grasp(tmp_path, "bleach", after_s=10, seed=1, reading=8)
    write_grasp(tmp_path, "bleach", after_s=90, seed=2, reading=7)
    write_grasp(tmp_path, "coffee", after_s=20, seed=3, reading=7)
    result = read(tmp_path)
    assert {name: recording.attributes.get("duplicate_of") for name, recording in result.items()} == {
        "bleach-1561629172": None,
        "bleach-1561629252": "coffee-1561629182",
        "coffee-1561629182": None,
        "wood-1561629212": "coffee-1561629182",
    }
    assert reading(result["wood-1561629212"]) == reading(result["coffee-1561629182"])


def test_what_a_grasp_is_named_by_is_in_its_files_and_other_grasps_are_not(tmp_path: Path) -> None:
    local = write_grasp(tmp_path)
    first_sources = discover(Params(), tmp_path)["bleach-1561629162"]
    assert first_sources == {
        f"bleach/1561629162/{name}": local / name for name in ("cloud-object.pcd", "best-grasp.txt", "tactile.tac")
    }
    write_grasp(tmp_path, after_s=9, seed=1)
    twin = write_grasp(tmp_path, "wood", after_s=-9, seed=2, reading=1)
    sources = discover(Params(), tmp_path)
    assert sources["bleach-1561629162"] == first_sources
    assert sources["bleach-1561629171"]["duplicate_of=wood-1561629153"] == twin / "tactile.tac"


def test_a_hit_of_an_ingest_of_grasps_imports_nothing_heavy(tmp_path: Path) -> None:
    write_grasp(tmp_path / "published")
    words = "ingest vision2tactile published -o data/recordings"
    assert "pyarrow" in imported(tmp_path, words)
    assert imported(tmp_path, words) & HEAVY == set()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("\n\n", "is empty"),
        ("," + ",".join(["7"] * 57), "row 1: there are 58 fields with an empty first one; there must be 59"),
        ("," + ",".join(["7"] * 116), "there are 117 fields with an empty first one, as many as 2 readings"),
        (",".join(["7"] * 59), "there are 59 fields with '7' as the first one"),
        (",".join(["7"] * 58), "there are 58 fields with '7' as the first one"),
        ("," + ",".join(["7"] * 58) + "\n," + ",".join(["8"] * 58), "has 2 rows; a grasp has one reading"),
        ("," + ",".join(["7"] * 57 + ["4096"]), "row 1, field 59: '4096' is not a count; .* from 0 to 4095"),
        ("," + ",".join(["-1"] + ["7"] * 57), "row 1, field 2: '-1' is not a count"),
        (
            "," + ",".join(["7"] * 9 + ["20.5"] + ["7"] * 48),
            "row 1, field 11: '20.5' is not a count; it must be a whole",
        ),
        ("," + ",".join(["7"] * 57 + [""]), "row 1, field 59: '' is not a count"),
        ("," + ",".join(["nan"] * 58), "'nan' is not a count"),
        ("," + ",".join(["7"] * 57 + ["٣"]), "cannot be read as text"),
    ],
)
def test_a_reading_that_is_none_is_refused_with_its_row(tmp_path: Path, text: str, message: str) -> None:
    path = write_grasp(tmp_path) / "tactile.tac"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(TacpipeError, match=rf"tactile\.tac.*{message}"):
        read(tmp_path)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\n\n"])
def test_a_line_end_behind_a_reading_is_none_of_its_values(tmp_path: Path, end: str) -> None:
    path = write_grasp(tmp_path) / "tactile.tac"
    path.write_bytes(path.read_bytes() + end.encode())
    assert reading(read(tmp_path)["bleach-1561629162"]) == counts()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("1,2,3,4,5", "the first of 5 numbers; it must be one line of 6 numbers"),
        ("1,2,3\n4,5,6", "has 2 lines, the first of 3 numbers"),
        ("0,0,1.1,0,0.05,x", "row 1: could not convert string to float: 'x'; all 6 cells must be numbers"),
        ("0,0,1.1,0,0,nan", r"best-grasp\.txt: The grasp points are .* both must be finite"),
        ("0,0,1.1,0,0,1.1", r"best-grasp\.txt: Both grasp points are"),
    ],
)
def test_a_grasp_that_is_none_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (write_grasp(tmp_path) / "best-grasp.txt").write_text(text)
    with pytest.raises(TacpipeError, match=message):
        read(tmp_path)


def test_a_grasp_beside_its_cloud_is_refused_with_the_distance(tmp_path: Path) -> None:
    folder = write_grasp(tmp_path)
    points = np.array([(0, 0, 1.1), (0.06, 0, 1.1)], np.float32)
    (folder / "cloud-object.pcd").write_bytes(header(2).encode() + packed(points, colours(count=2)))
    (folder / "best-grasp.txt").write_text("0,0.019,1.1,0.06,0.021,1.1")
    with pytest.raises(TacpipeError, match=r"21\.0 mm.*20 mm"):
        read(tmp_path)
    assert len(read(tmp_path, Params(beside_mm=21.5))) == 1


def test_a_cloud_in_millimetres_is_refused(tmp_path: Path) -> None:
    folder = write_grasp(tmp_path)
    points = 1000 * points_m()
    (folder / "cloud-object.pcd").write_bytes(header(50).encode() + packed(points, colours()))
    (folder / "best-grasp.txt").write_text(",".join(map(str, points[:2].ravel())))
    with pytest.raises(TacpipeError, match=r"cloud-object\.pcd"):
        read(tmp_path)


def test_a_cloud_without_colours_gives_no_colour_columns(tmp_path: Path) -> None:
    path = write_grasp(tmp_path) / "cloud-object.pcd"
    head = header(50, FIELDS="x y z", SIZE="4 4 4", TYPE="F F F", COUNT="1 1 1")
    path.write_bytes(head.encode() + points_m().tobytes())
    (result,) = read(tmp_path).values()
    assert result.streams["cloud"].column_names == ["x_m", "y_m", "z_m"]


def test_folders_and_files_that_are_missing_doubled_or_misnamed_are_told(tmp_path: Path) -> None:
    with pytest.raises(TacpipeError, match=r"cloud-object\.pcd"):
        discover(Params(), tmp_path)
    folder = write_grasp(tmp_path / "set")
    with pytest.raises(TacpipeError, match="is not a folder"):
        discover(Params(), folder / "tactile.tac")
    for name in ("cloud-object.pcd", "tactile.tac"):
        content = (folder / name).read_bytes()
        (folder / name).unlink()
        with pytest.raises(TacpipeError, match=f"lacks {name}"):
            read(tmp_path)
        (folder / name).write_bytes(content)
    write_grasp(tmp_path / "copy")
    with pytest.raises(TacpipeError, match=r"copy.* and .*set.* would both be named .*-\d{10}\. Rename one"):
        discover(Params(), tmp_path)
    folder.rename(folder.with_name("first"))
    with pytest.raises(TacpipeError, match="'first'"):
        read(tmp_path / "set")


@pytest.mark.data
@pytest.mark.skipif(not PUBLISHED.is_dir(), reason="the published recordings are not here")
def test_the_published_grasps_lie_on_their_clouds_and_within_the_published_ranges() -> None:
    result = read(PUBLISHED)
    assert len(result) == 280
    assert {recording.attributes["object"] for recording in result.values()} == {
        "bleach", "campbells", "cheezit", "coffee", "pringles", "spam", "wood"
    }  # fmt: skip
    sizes = []
    for recording in result.values():
        cloud, grasp = Cloud.from_table(recording.streams["cloud"]), Grasp.from_table(recording.streams["grasp"])
        sizes.append(len(cloud))
        assert cloud.colours is not None
        assert 0.026 < grasp.opening_m < 0.121
        for point_m in (grasp.g1_m, grasp.g2_m):
            assert np.linalg.norm(cloud.points_m - point_m, axis=1).min() < 1e-6
        for target in biotac_sp.TARGETS:
            table = recording.streams["reading"].select(biotac_sp.columns(target))
            shares = biotac_sp.normalise(target, np.array([column[0].as_py() for column in table.columns]))
            assert shares.min() >= 0 and shares.max() <= 1
        assert "duplicate_of" not in recording.attributes
    assert (min(sizes), max(sizes)) == (1021, 5567)


@pytest.mark.data
@pytest.mark.skipif(not PUBLISHED.is_dir(), reason="the published recordings are not here")
def test_the_published_sessions_are_apart_by_a_night_and_go_on_within_two_hours() -> None:
    times: dict[str, list[int]] = {}
    for name in discover(Params(), PUBLISHED):
        label, _, time_s = name.rpartition("-")
        times.setdefault(label, []).append(int(time_s))
    for label, items in times.items():
        items.sort()
        for before, after in pairwise(items):
            same = session(label, before) == session(label, after)
            assert after - before < 2 * 3600 if same else after - before > 18 * 3600
