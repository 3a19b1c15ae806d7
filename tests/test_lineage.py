import os

from tests.conftest import FileCalls, Lab, write_source


def explain(lab: Lab, path: str) -> dict[str, object]:
    value: dict[str, object] = lab.run_json(f"explain {path}")
    return value


def test_the_lineage_goes_down_to_the_raw_files(lab: Lab) -> None:
    from tacpipe.io.hashing import file_digest

    write_source("src", a="1 2 3")
    lab.run("ingest numbers src -o data/r")
    lab.run("scale data/r -o data/s --factor 4")
    lab.run("total data/s -o data/t")
    tree = lab.run_json("explain data/t")
    synced = tree["inputs"]["datasets"][0]
    recordings = synced["inputs"]["datasets"][0]
    assert (tree["stage"], synced["stage"], recordings["stage"]) == ("total", "scale", "ingest.numbers")
    assert synced["params"]["factor"] == 4 and synced["path"].endswith("data/s")
    assert recordings["sources"] == {"a": {"a.txt": file_digest("src/a.txt")}}
    printed = lab.run("explain data/t").out
    assert "factor=4" in printed and "1 raw file of 1 recording" in printed and "numpy" in printed


def test_the_part_of_the_key_that_changed_is_named(lab: Lab) -> None:
    write_source("src", a="1 2 3", b="1 2 3")
    lab.run("ingest numbers src -o data/r")
    lab.run("scale data/r -o data/s")
    assert explain(lab, "data/s")["changes"] is None
    lab.run("scale data/r -o data/s --factor 3")
    assert explain(lab, "data/s")["changes"] == ["params.factor: 2 became 3"]
    write_source("src", a="9", c="7")
    lab.run("ingest numbers src -o data/r --replace")
    assert explain(lab, "data/r")["changes"] == ["sources: 1 new (c)", "sources: 1 other (a)"]
    lab.run("scale data/r -o data/s --factor 3")
    assert explain(lab, "data/s")["changes"] == [
        "inputs.datasets.shards: 1 new (c)",
        "inputs.datasets.shards: 1 other (a)",
    ]
    lab.run("label data/r b --set material=foam")
    assert explain(lab, "data/r")["changes"] == ["labels: 1 new (b)"]
    lab.run("scale data/r -o data/s --factor 3")
    assert explain(lab, "data/s")["changes"] == ["inputs.datasets.attributes: 1 other (b)"]


def test_a_dataset_that_came_without_its_ancestors_is_explained_as_far_as_it_goes(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    for path in lab.store.root.glob("objects/*/*"):
        if path.read_bytes()[:1] == b"{" and b'"simulate.toy"' in path.read_bytes():
            path.unlink()
    assert "not in this store" in lab.run("explain data/s").out


def test_explain_reads_the_record_of_the_dataset_and_not_those_of_its_recordings(
    lab: Lab, file_calls: FileCalls
) -> None:
    lab.run("simulate toy --trials 30 --rows 3 -o data/r --jobs 1")
    lab.run("scale data/r -o data/s --jobs 1")
    for dataset in ("data/r", "data/s"):
        file_calls.clear()
        assert explain(lab, dataset)["provenance"] is not None
        assert file_calls.take("records") == 1 < len(list(lab.store.root.glob("records/*/*"))) / 30


def test_a_record_that_was_written_at_another_time_than_its_root_is_found_all_the_same(lab: Lab) -> None:
    lab.run("simulate toy --trials 3 --rows 3 -o data/r --jobs 1")
    provenance = explain(lab, "data/r")["provenance"]
    for number, path in enumerate(sorted(lab.store.root.glob("records/*/*"))):
        os.utime(path, (10**9 + number, 10**9 + number))
    assert provenance is not None and explain(lab, "data/r")["provenance"] == provenance
