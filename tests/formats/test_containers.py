"""Parts that all formats of containers share, tried with a fake container."""

import json
import tomllib
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.formats import container
from tacpipe.formats.container import Kind
from tacpipe.formats.table import contained
from tacpipe.formats.table.contained import LayoutCommand, Params
from tacpipe.plugins.stage import RecordingOutput
from tests.formats import fake_container
from tests.formats.builders import layout_params

COMMAND = LayoutCommand("xdf")
NONE = Params()


@pytest.fixture(autouse=True)
def _fake(monkeypatch: pytest.MonkeyPatch) -> None:
    kind = Kind("tests.formats.fake_container:opened", endings=(".fake", ".fake.json"), marks=("meta/mark",))
    kinds: Any = container.KINDS  # one mapping, which every module of formats reads
    for name in list(kinds):
        monkeypatch.delitem(kinds, name)
    monkeypatch.setitem(kinds, "xdf", kind)


def read(folder: Path, params: Params = NONE) -> dict[str, RecordingOutput]:
    return {
        name: COMMAND.read(params, value.files, value.values)
        for name, value in COMMAND.discover(params, folder).items()
    }


def test_without_a_layout_streams_are_as_their_file_declares_them(tmp_path: Path) -> None:
    fake_container.write(tmp_path / "day" / "run 1.fake")
    result = read(tmp_path)["run-1"]
    table = result.streams["skin"]
    assert table.column("t_ns").to_pylist() == [10**9, 2 * 10**9]
    assert table.schema.field("t_ns").metadata == {b"unit": b"ns", b"quantity": b"time", b"clock": b"header stamp"}
    assert table.schema.field("t2").type == pa.float32()
    assert table.schema.field("t2").metadata == {b"quantity": b"tactile", b"taxel": b"7"}
    assert str(table.column("t1").to_pylist()) == "[0.5, nan]"
    assert result.attributes == {"robot": "panda"}


def test_a_rule_replaces_what_it_states_and_nothing_else(tmp_path: Path) -> None:
    fake_container.write(tmp_path / "a.fake")
    params = layout_params('[streams.pad]\nsource = "/skin"\ncolumns = [{ match = "t{taxel}", unit = "N" }]')
    (result,) = read(tmp_path, params).values()
    field = result.streams["pad"].schema.field("t2")
    assert field.type == pa.float32()
    assert field.metadata == {b"quantity": b"tactile", b"taxel": b"2", b"unit": b"N"}


def test_a_layout_of_a_table_reads_a_container_beside_a_csv(tmp_path: Path) -> None:
    fake_container.write(tmp_path / "t1" / "skin.fake")
    (tmp_path / "t1" / "arm.csv").write_text("time,x\n1,5\n")
    text = """
    [streams.skin]
    files = "{trial}/skin.fake"
    format = "xdf"
    source = "/skin"
    [streams.arm]
    files = "{trial}/arm.csv"
    time = { column = "time" }
    columns = [{ match = "x" }]
    """
    command, params = LayoutCommand(None), Params(layout=json.dumps(tomllib.loads(text)))
    source = command.discover(params, tmp_path)["t1"]
    output = command.read(params, source.files, source.values)
    assert {name: len(table.read_all() if name == "arm" else table) for name, table in output.streams.items()} == {
        "skin": 2,
        "arm": 1,
    }
    assert output.attributes == {"robot": "panda", "trial": "t1"}


def test_episodes_inside_a_file_are_recordings(tmp_path: Path) -> None:
    stamps = {"stamp": [1, 2], "t1": [1, 2]}
    episodes = {"demo_0": {"/skin": stamps}, "demo_1": {"/skin": {"stamp": [7], "t1": [7]}}}
    fake_container.write(tmp_path / "all.fake", episodes=episodes)
    assert {name: value.streams["skin"].num_rows for name, value in read(tmp_path).items()} == {
        "all-demo_0": 2,
        "all-demo_1": 1,
    }
    by_name = layout_params('[recordings]\nname = "{recording}-of-{file}"')
    assert sorted(read(tmp_path, by_name)) == ["demo_0-of-all", "demo_1-of-all"]


def test_what_cannot_be_read_is_named_in_notes_and_in_the_attributes(tmp_path: Path) -> None:
    fake_container.write(tmp_path / "a.fake", skipped={"/odd": "its encoding is foo"}, notes=["cut off"])
    (result,) = read(tmp_path).values()
    assert result.attributes["skipped"] == "/odd: its encoding is foo"
    assert result.notes[0] == "cut off" and "/odd" in result.notes[1] and "foo" in result.notes[1]


def test_a_stream_that_is_not_there_is_an_error_with_the_reason_unless_it_is_optional(tmp_path: Path) -> None:
    fake_container.write(tmp_path / "a.fake", skipped={"/odd": "its encoding is foo"})
    for source, by_name in (("/odd", "encoding is foo"), ("/no", "it has /skin")):
        text = f'[streams.s]\nsource = "{source}"\n[streams.skin]\nsource = "/skin"\n'
        with pytest.raises(TacpipeError, match=by_name):
            read(tmp_path, layout_params(text))
    optional = layout_params('[streams.s]\nsource = "/no"\noptional = true\n[streams.skin]\nsource = "/skin"')
    assert list(read(tmp_path, optional)["a"].streams) == ["skin"]


def test_a_guess_given_back_reads_the_same(tmp_path: Path) -> None:
    fake_container.write(tmp_path / "a.fake")
    guessed = COMMAND.guess(tmp_path)
    (plain,) = read(tmp_path).values()
    (reread,) = read(tmp_path, layout_params(guessed)).values()
    assert reread.streams["skin"].schema.equals(plain.streams["skin"].schema, check_metadata=True)
    assert reread.streams["skin"].drop("t1").equals(plain.streams["skin"].drop("t1"))


def test_a_dry_run_describes_streams_and_what_is_left_out(tmp_path: Path) -> None:
    fake_container.write(tmp_path / "a.fake", skipped={"/odd": "its encoding is foo"})
    text = COMMAND.preview(NONE, tmp_path)
    assert "skin: 2 rows" in text and "/odd" in text and "panda" in text


def test_files_of_one_name_are_named_with_their_folders(tmp_path: Path) -> None:
    for place in ("monday/run.fake", "tuesday/run.fake", "tuesday/other.fake.json"):
        fake_container.write(tmp_path / place)
    assert sorted(COMMAND.discover(NONE, tmp_path)) == ["monday-run", "other", "tuesday-run"]


def test_a_folder_with_a_mark_is_one_container_whose_files_all_count(tmp_path: Path) -> None:
    for name in ("meta/mark", "data/a.fake", "data/b.fake"):
        (tmp_path / "set" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "set" / name).write_text("{}")
    assert (
        container.find_containers("xdf", tmp_path)
        == container.find_containers("xdf", tmp_path / "set")
        == [tmp_path / "set"]
    )
    files = contained.member_files({"container": tmp_path / "set"})
    assert sorted(files) == ["container/data/a.fake", "container/data/b.fake", "container/meta/mark"]
    assert contained.container_paths(files) == {"container": tmp_path / "set"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[streams.s]\nsource = ""', "source"),
        ('[streams.s]\nsource = "/a"\nrecording = "x"', "recording"),
        ('[streams.s]\nsource = "/a"\nfiles = "a.fake"\n[streams.r]\nsource = "/b"', "files"),
        ('[streams.s]\nsource = "/a"\nformat = "csv"', "source"),
    ],
)
def test_a_wrong_layout_of_a_container_is_one_sentence(text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        COMMAND.parsed(layout_params(text))


@pytest.mark.parametrize("name", ["", "a.yaml", "gone"])
def test_what_holds_no_container_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "a.yaml").write_text("a: 1")
    for look in (lambda: COMMAND.discover(NONE, tmp_path / name), lambda: COMMAND.guess(tmp_path / name)):
        with pytest.raises(UsageError, match=name if name == "gone" else r"\.fake"):
            look()


def test_a_guess_and_a_dry_run_go_on_past_a_container_without_streams(tmp_path: Path) -> None:
    (tmp_path / "a.fake.json").write_text(json.dumps({"streams": {}}))
    fake_container.write(tmp_path / "b.fake")
    (tmp_path / "notes.txt").write_text("none")
    guessed = COMMAND.guess(tmp_path)
    assert "[streams.skin]" in guessed and "What b.fake itself declares" in guessed
    assert "a.fake.json holds no stream" in guessed and "notes.txt" in guessed
    assert "skin: 2 rows" in COMMAND.preview(NONE, tmp_path)
    (tmp_path / "b.fake").unlink()
    with pytest.raises(TacpipeError, match="holds no stream"):
        COMMAND.guess(tmp_path)
