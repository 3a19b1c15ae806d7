"""Test the table that the split stage writes."""

import json
from collections.abc import Callable
from typing import Any

import pyarrow as pa
import pytest

import tacpipe
from tacpipe.datasets import selection
from tacpipe.errors import TacpipeError
from tacpipe.plugins.registry import load
from tests.conftest import Lab
from tests.fake_recordings import FakeDataset, write_dataset
from tests.stage_params import build_params

split = load("split")
Recording = Callable[..., Any]


def dataset(shard: Recording, count: int) -> FakeDataset:
    return FakeDataset({f"t{i:02d}": shard({}, f"t{i:02d}", {"object": str(i % 4)}) for i in range(count)})


def test_the_split_is_one_table_with_a_row_a_recording_and_fold(shard: Recording) -> None:
    result = split(build_params("split", scheme="leave-one-out"), dataset(shard, 12))
    assert set(result.recordings) == {"split"}
    table = result.recordings["split"].tables
    assert table.schema == pa.schema([("recording", pa.string()), ("fold", pa.int32()), ("role", pa.string())])
    assert table.num_rows == 12 * 4
    assert set(table.column("role").to_pylist()) == {"train", "val", "test"}


def test_the_same_params_give_the_same_table(shard: Recording) -> None:
    tables = [split(build_params("split", seed=3), dataset(shard, 20)).recordings["split"].tables for _ in range(2)]
    assert tables[0].equals(tables[1])


def test_every_param_reaches_the_scheme(shard: Recording) -> None:
    params = build_params("split", scheme="kfold", folds=2, val=0.25, seed=5, stratify="object", apart="object")
    rows = split(params, dataset(shard, 16)).recordings["split"].tables.to_pylist()
    objects = {f"t{i:02d}": i % 4 for i in range(16)}
    for fold in (0, 1):
        learned = {objects[row["recording"]] for row in rows if row["fold"] == fold and row["role"] != "test"}
        assert len(learned) == 2


def test_a_missing_attribute_is_an_error_sentence(shard: Recording) -> None:
    with pytest.raises(TacpipeError, match="has no attribute authors_role"):
        split(build_params("split", scheme="authors"), dataset(shard, 3))


def test_the_options_of_few_repeats_and_reverse_reach_the_scheme(shard: Recording) -> None:
    source = dataset(shard, 16)
    few_params = build_params("split", test=0.25, val=0.0, few=1, few_by="object", few_of="object=2", repeats=2)
    rows = split(few_params, source).recordings["split"].tables.to_pylist()
    assert {row["fold"] for row in rows} == {0, 1}
    for fold in (0, 1):
        object_roles = [row["role"] for row in rows if row["fold"] == fold and int(row["recording"][1:]) % 4 == 2]
        assert object_roles.count("train") == 1
        assert "unused" in object_roles
        assert not any(row["role"] == "unused" for row in rows if int(row["recording"][1:]) % 4 != 2)
    blocked = build_params("split", scheme="blocked", test=0.25, val=0.0, reverse=True)
    rows = split(blocked, source).recordings["split"].tables.to_pylist()
    assert [row["recording"] for row in rows if row["role"] == "test"] == ["t00", "t01", "t02", "t03"]


@pytest.mark.parametrize(
    ("params", "count", "expected_note"),
    [
        (
            {},
            3,
            "Fold 0 of 1 has no validation recording: val 0.15 of 3 recordings gives none. Give --val 0.2, or --val 0 ",
        ),
        ({"scheme": "kfold", "folds": 2, "val": 0.1}, 4, "Folds 0, 1 of 2 have no validation recording: val 0.1 of 4 "),
        ({"scheme": "leave-one-out", "val": 0.1}, 4, "Folds 0, 1, 2, 3 of 4 have no validation recording"),
        ({"scheme": "kfold", "folds": 7, "val": 0.05}, 7, "Folds 0, 1, 2, 3, 4 and 2 more of 7 have"),
        ({"val": 0.1, "test": 0.0}, 1, "val 0.1 of 1 recordings gives none. Add recordings, or --val 0 "),
    ],
)
def test_folds_without_validation_recordings_are_noted_with_a_share_that_gives_them_some(
    params: dict[str, Any], count: int, expected_note: str, shard: Recording
) -> None:
    (note,) = split(build_params("split", **params), dataset(shard, count)).notes
    assert expected_note in note
    if "Give --val " in note:
        enough = float(note.split("Give --val ")[1].split(",")[0])
        assert split(build_params("split", **{**params, "val": enough}), dataset(shard, count)).notes == []


@pytest.mark.parametrize(("params", "count"), [({"val": 0.0}, 3), ({}, 12), ({"scheme": "kfold", "val": 0.0}, 5)])
def test_a_split_with_validation_recordings_or_asked_for_without_has_no_note(
    params: dict[str, Any], count: int, shard: Recording
) -> None:
    assert split(build_params("split", **params), dataset(shard, count)).notes == []


def roles_of(path: str) -> dict[tuple[str, int], str]:
    rows = tacpipe.open(path)["split"].table().to_pylist()
    return {(row["recording"], row["fold"]): row["role"] for row in rows}


def numbers(values: list[int]) -> dict[str, pa.Table]:
    return {"skin": pa.table({"t_ns": range(len(values)), "taxel1": values})}


@pytest.fixture
def copies(lab: Lab) -> Lab:
    """A project with ten recordings ``plain``, and ``copied``, the same with copies of three of them."""
    plain = {f"t{i}": (numbers([i, i + 1]), {"object": str(i % 5)}) for i in range(10)}
    write_dataset(lab.folder / "plain", plain)
    write_dataset(lab.folder / "copied", plain | {f"z{i}": plain[f"t{i}"] for i in range(3)})
    return lab


@pytest.mark.parametrize("options", ["", "--scheme kfold", "--scheme leave-one-out", "--scheme blocked", "--few 3"])
def test_recordings_with_equal_content_have_one_role_and_a_note_names_them(options: str, copies: Lab) -> None:
    ran = copies.run(f"split copied -o split {options}")
    assert "3 recordings have the content of another one, and have its role: t0 = z0, t1 = z1, t2 = z2." in ran.err
    roles = roles_of("split")
    assert all(roles[f"t{i}", fold] == roles[f"z{i}", fold] for i in range(3) for _, fold in roles)
    assert "0 ran, 1 reused" in copies.run(f"split copied -o split {options}").err


def test_only_equal_content_that_would_be_separated_and_a_group_that_is_given_enter_the_key(copies: Lab) -> None:
    def identities() -> list[Any]:
        records = [json.loads(path.read_text()) for path in (copies.folder / ".tacpipe").rglob("*.json")]
        return [record["identity"] for record in records if record.get("identity", {}).get("stage") == "split"]

    copies.run("split plain -o split")
    copies.run("split copied -o split-authors --scheme blocked --stratify object --test 0 --val 0")
    assert [set(identity["inputs"]) - {"recordings", "extend"} for identity in identities()] == [set(), set()]
    assert not any("group" in identity["params"] for identity in identities())
    copies.run("split copied -o split-copied")
    copies.run("split plain -o split-grouped --group object")
    assert sum("equal" in identity["inputs"] for identity in identities()) == 1
    assert [identity["params"]["group"] for identity in identities() if "group" in identity["params"]] == ["object"]


def test_a_split_stored_before_copies_stayed_together_is_not_used(copies: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(selection, "equal_recordings", lambda entries: [])
        copies.run("split copied -o older")
    older = roles_of("older")
    separate = [f"t{i} = z{i}" for i in range(3) if older[f"t{i}", 0] != older[f"z{i}", 0]]
    assert separate
    assert "1 ran" in copies.run("split copied -o split").err
    extended = copies.run("split copied -o extended --extend older")
    assert f"keep different roles of the split to extend: {', '.join(separate)}." in extended.err
    assert roles_of("extended") == older


def test_apart_divides_groups_so_both_are_refused(copies: Lab) -> None:
    ran = copies.call("split plain -o split --scheme kfold --apart object --group object")
    assert ran.code == 2
    assert "apart divides groups" in ran.err
