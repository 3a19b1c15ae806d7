"""The public Python API: what it returns, what it refuses, and what importing it costs."""

import html
import inspect
import json
import pickle
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pandas as pd
import polars as pl
import pyarrow as pa
import pytest
import torch

import tacpipe
from tacpipe.datasets.dataset import Dataset
from tacpipe.engine import calling
from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tests.conftest import Lab, run_python, write_source
from tests.fake_recordings import publish_dataset

STEP_NS = 20_000_000
HEAVY = {"torch", "pyarrow", "pandas", "polars", "duckdb", "numpy", "sklearn", "typer"}


def synchronized_table(
    rows: int = 12, *, gap: int | None = None, late: int | None = None, nan: int | None = None
) -> pa.Table:
    """Return a table of two streams side by side, as `tacpipe synchronize` makes it."""
    t_ns = np.arange(rows) * STEP_NS  # (time,)
    if late is not None:
        t_ns[late:] += 5 * STEP_NS
    force = np.arange(rows) * 0.5
    if nan is not None:
        force[nan] = np.nan
    masked = np.arange(rows) == (-1 if gap is None else gap)
    columns: list[tuple[str, Any, dict[str, str]]] = [
        ("t_ns", t_ns, {"quantity": "time"}),
        ("left_x", np.arange(rows, dtype=np.uint16), {"stream": "left", "quantity": "tactile"}),
        ("left_gap", masked, {"stream": "left", "quantity": "mask"}),
        ("arm_force_n", force, {"stream": "arm", "quantity": "force"}),
        ("gt_x", np.arange(rows), {"stream": "truth"}),
    ]
    fields = [pa.field(name, pa.array(values).type, metadata=about) for name, values, about in columns]
    return pa.Table.from_arrays([pa.array(values) for _, values, _ in columns], schema=pa.schema(fields))


def publish(lab: Lab, path: str, tables: dict[str, dict[str, pa.Table]], **labels: list[Any]) -> Dataset:
    """Publish recordings by name and stream, each label a list of one value a recording, and open them."""
    publish_dataset(lab.store, lab.folder / path, tables, **labels)
    return tacpipe.open(lab.folder / path)


@pytest.fixture
def four(lab: Lab) -> Dataset:
    """Four recordings of twelve rows, labelled."""
    return publish(
        lab,
        "data/four",
        {f"trial-{place:03d}": {"": synchronized_table()} for place in range(4)},
        object=["cup", "egg", "cup", None],
        speed_m_s=[0.1, 0.2, 0.3, 0.4],
        trial=[0, 1, 2, None],
    )


# ---- the surface


def test_importing_tacpipe_imports_nothing_heavy_and_every_public_name_is_there() -> None:
    code = (
        "import sys, json, tacpipe; before = sorted(name.partition('.')[0] for name in sys.modules);"
        "missing = [name for name in tacpipe.__all__ if not hasattr(tacpipe, name) or name not in dir(tacpipe)];"
        "print(json.dumps([before, missing, sorted(name.partition('.')[0] for name in sys.modules)]))"
    )
    process = run_python(Path(), "-c", code, check=True)
    before, missing, after = json.loads(process.stdout)
    assert not set(before) & HEAVY and not missing
    assert not set(after) & HEAVY  # the classes of datasets are light too


def test_the_public_names_are_those_promised_and_documented() -> None:
    assert set(inspect.get_annotations(calling.How)) <= set(inspect.signature(tacpipe.run).parameters)
    promised = {"open", "load", "run", "Dataset", "Recording", "RecordingOutput", "Result", "stage", "Stage"}
    assert promised | {"__version__", "TacpipeError", "UsageError"} <= set(tacpipe.__all__)
    errors = {
        member for _, member in inspect.getmembers(tacpipe.errors, inspect.isclass) if issubclass(member, Exception)
    }
    assert {error.__name__ for error in errors if error.__module__ == "tacpipe.errors"} <= set(tacpipe.__all__)
    for name in tacpipe.__all__:
        public = getattr(tacpipe, name)
        assert name == "__version__" or (public.__doc__ or "").strip(), name
        members = inspect.getmembers(public) if inspect.isclass(public) and not issubclass(public, Exception) else []
        for member, value in members:
            if not member.startswith("_") and (inspect.isfunction(value) or isinstance(value, property)):
                assert (inspect.getdoc(value) or "").strip(), f"{name}.{member}"
    with pytest.raises(AttributeError, match="nothing"):
        tacpipe.nothing  # noqa: B018


def test_no_param_of_a_built_in_stage_shares_its_name_with_an_argument_of_run() -> None:
    arguments = set(inspect.signature(tacpipe.run).parameters) - {"params", "name", "datasets"}
    for name in registry.stages():
        assert not arguments & set(params_of.fields(registry.load(name))), name


# ---- run


def test_run_answers_what_the_command_computed_and_the_other_way_round(lab: Lab) -> None:
    lab.run("simulate toy -o data/r --trials 3")
    lab.run("scale data/r -o data/s --factor 3")
    before = lab.store.roots.get((lab.folder / "data/s").absolute())
    dataset = tacpipe.run("scale", "data/r", output="data/s", factor=3)
    assert dataset.path == lab.folder / "data/s" and dataset.manifest["params"]["factor"] == 3
    assert lab.store.roots.get((lab.folder / "data/s").absolute()) == before
    tacpipe.run("scale", tacpipe.open("data/r"), output=Path("data/five"), factor=5)
    assert lab.run_json("scale data/r -o data/five --factor 5")["reused"] == 3


def test_run_splits_fits_and_writes_one_file_like_the_commands(lab: Lab) -> None:
    tacpipe.run("simulate.toy", output="data/r", trials=4)
    tacpipe.run("scale", "data/r", output="data/s")
    split = tacpipe.run("halves", "data/s", output="data/split")
    centred = tacpipe.run("centre", "data/s", split="data/split", output="data/c")
    recentred = tacpipe.run("centre", "data/s", codec=centred, output="data/c2")
    assert centred.digest == recentred.digest and [recording.name for recording in recentred] == [
        f"trial-{n:03d}" for n in range(4)
    ]
    assert set(centred.select(split=split, role="train").recordings) == {"trial-000", "trial-001"}
    page = tacpipe.run("page", "data/s", output="page.html")
    assert page == Path("page.html") and page.read_text() == "<p>4 recordings</p>"
    write_source("numbers", a="1\n2\n")
    read = tacpipe.run("ingest.numbers", "numbers", output="data/n")
    assert read["a"].table("left")["x"].to_pylist() == [1, 2]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"faktor": 3}, "faktor"),
        ({"factor": "many"}, "many"),
        ({"role": "test"}, "role"),
        ({"split": "data/split"}, "split"),
        ({"jobs": -1}, "-1"),
        ({"preset": "slow"}, "slow"),
    ],
)
def test_run_refuses_a_wrong_keyword_or_value_before_anything_is_read(
    lab: Lab, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(tacpipe.UsageError, match=words):
        tacpipe.run("scale", "data/none", output="data/s", **options)
    assert not (lab.folder / "data").exists()


def test_run_refuses_an_unknown_stage_a_missing_dataset_and_a_part_of_one(lab: Lab) -> None:
    tacpipe.run("simulate.toy", output="data/r")
    for name, datasets in (("skale", ["data/r"]), ("scale", []), ("simulate.toy", ["data/r"]), ("ingest.numbers", [])):
        with pytest.raises(tacpipe.UsageError, match=name):
            tacpipe.run(name, *datasets, output="data/s")
    with pytest.raises(tacpipe.UsageError, match="1 of the 4"):
        tacpipe.run("scale", tacpipe.open("data/r").select("trial-001"), output="data/s")


def test_run_shows_no_progress_and_warns_of_recordings_that_it_left_out(
    lab: Lab, capsys: pytest.CaptureFixture[str]
) -> None:
    write_source("numbers", good="1 2", bad="1 x")
    with pytest.warns(tacpipe.ResultWarning, match=r"bad.*x") as warnings:
        dataset = tacpipe.run("ingest.numbers", "numbers", output="data/n", skip_bad=True)
    assert {Path(warning.filename).name for warning in warnings} == {Path(__file__).name}
    assert [recording.name for recording in dataset] == ["good"]
    assert capsys.readouterr() == ("", "")


def test_a_script_without_a_guard_runs_once_and_its_workers_do_not_run_it(lab: Lab) -> None:
    script = "import tacpipe\nprint('once')\ntacpipe.run('simulate.toy', output='data/r', trials=9, jobs=2)\n"
    (lab.folder / "script.py").write_text(script)
    process = run_python(Path(), "script.py")
    assert (process.returncode, process.stdout, process.stderr) == (0, "once\n", "")
    assert len(tacpipe.open("data/r")) == 9


# ---- a dataset


def test_a_dataset_is_a_collection_of_its_recordings_by_name(four: Dataset) -> None:
    names = [f"trial-{place:03d}" for place in range(4)]
    assert len(four) == 4 and [recording.name for recording in four] == names and list(four.recordings) == names
    assert four["trial-002"] is four.recordings["trial-002"] and "trial-002" in four and "trial-009" not in four
    with pytest.raises(tacpipe.UsageError, match="trial-009"):
        four["trial-009"]
    assert bool(four.only([]))  # a model, which has no recordings, is a dataset too


def test_a_stream_of_a_synchronized_recording_has_the_names_with_which_it_was_recorded(four: Dataset) -> None:
    recording = four["trial-001"]
    assert recording.table("left").to_pydict() == {"t_ns": [n * STEP_NS for n in range(12)], "x": list(range(12))}
    assert recording.table("arm", ["force_n"]).column_names == ["force_n"]
    assert recording.table().column_names == synchronized_table().column_names
    with pytest.raises(tacpipe.UsageError, match=r"right.*left"):
        recording.table("right")
    assert four.to_pandas("left").columns.tolist() == ["recording", "t_ns", "x"]


def test_labels_are_one_row_a_recording_in_types_that_hold_them(four: Dataset) -> None:
    labels = four.labels
    assert labels.index.tolist() == list(four.recordings) and labels.index.name == "recording"
    assert labels["object"].tolist()[:3] == ["cup", "egg", "cup"] and labels["object"].isna().tolist() == [
        False
    ] * 3 + [True]
    assert labels["speed_m_s"].dtype == np.float64 and labels["trial"].dtype == pd.Int64Dtype()


def test_select_keeps_the_recordings_that_meet_every_condition(four: Dataset, lab: Lab) -> None:
    def chosen(*names: str, **conditions: Any) -> list[int]:
        return [int(recording.name[-3:]) for recording in four.select(*names, **conditions)]

    assert chosen("trial-00[12]") == [1, 2]
    assert chosen(object="cup") == [0, 2]
    assert chosen(object=["cup", "egg"], trial=lambda n: n > 0) == [1, 2]
    assert chosen(labels={"object": "egg"}) == [1]
    rows = pa.table(
        {
            "recording": ["trial-000", "trial-001", "trial-000", "trial-002"],
            "fold": pa.array([0, 0, 1, 1], pa.int32()),
            "role": ["train", "test", "val", "train"],
        }
    )
    publish(lab, "data/split", {"split": {"": rows}})
    assert chosen(split="data/split") == [0, 1]
    assert chosen(split=tacpipe.open("data/split"), role="train", fold=1) == [2]
    wrong: list[dict[str, Any]] = [
        {"object": "bowl"},
        {"colour": "red"},
        {"split": "data/split", "role": "train", "fold": 7},
        {"split": "data/split", "role": "dev"},
        {"role": "train"},
        {"split": four, "role": "train"},
    ]
    for conditions in wrong:
        with pytest.raises(tacpipe.UsageError):
            four.select(**conditions)
    with pytest.raises(tacpipe.UsageError, match="trial-1"):
        four.select("trial-1*")


def test_frames_hold_the_rows_of_all_recordings_and_labels_if_asked(four: Dataset) -> None:
    table, frame = four.to_arrow(labels=["object", "trial"]), four.to_pandas(labels=True)
    assert table.column_names[-2:] == ["object", "trial"] and table.num_rows == 48
    assert frame.groupby("recording", observed=True)["speed_m_s"].first().tolist() == [0.1, 0.2, 0.3, 0.4]
    assert table["trial"].to_pylist()[-12:] == [None] * 12 and pa.types.is_int64(table.schema.field("trial").type)
    polars = four.to_polars(labels=["object"])
    assert isinstance(polars, pl.DataFrame)
    assert polars["object"].to_list() == table["object"].to_pylist()
    assert four.to_polars().rows() == [tuple(row.values()) for row in four.to_arrow().to_pylist()]
    with pytest.raises(tacpipe.UsageError, match="colour"):
        four.to_pandas(labels=["colour"])


def test_a_label_that_shares_its_name_with_a_column_is_refused_by_name(lab: Lab) -> None:
    dataset = publish(lab, "data/one", {"a": {"": pa.table({"x": [1]})}}, x=["label"], y=[3])
    with pytest.raises(tacpipe.UsageError, match=r"\['y'\]"):
        dataset.to_pandas(labels=True)
    assert dataset.to_pandas(labels=["y"])["y"].tolist() == [3]


def test_duckdb_has_a_view_a_stream_and_one_of_the_labels(lab: Lab, four: Dataset) -> None:
    connection = four.duckdb()
    assert isinstance(connection, duckdb.DuckDBPyConnection)
    sums = connection.sql(
        "select object, sum(left_x) from data join labels using (recording) where object is not null "
        "group by object order by object"
    ).fetchall()
    assert sums == [("cup", 2 * sum(range(12))), ("egg", sum(range(12)))]
    unlike = publish(lab, "data/apart", {"a": {"left": pa.table({"x": [1, 2]})}, "b": {"right": pa.table({"y": [3]})}})
    views = unlike.duckdb()
    assert [row[0] for row in views.sql("show tables").fetchall()] == ["labels", "left", "right"]
    assert views.sql('select recording, y from "right"').fetchall() == [("b", 3)]


def test_a_dataset_describes_itself_and_nothing_of_it_reaches_a_notebook_as_markup(lab: Lab) -> None:
    word = "<script>alert(1)</script>"
    dataset = publish(lab, "data/odd", {"a": {"": synchronized_table()}}, object=[word])
    text = repr(dataset)
    for part in ("scale", "factor=2", "1: a", "50 Hz", "left", "arm", word):
        assert part in text
    markup = dataset._repr_html_()
    assert word not in markup and html.escape(word) in markup and len(markup) < 2000
    assert "of 2" in repr(publish(lab, "data/two", {n: {"": synchronized_table()} for n in "ab"}).select("a"))
    (lab.folder / "data/odd/a.parquet").unlink()
    Path(lab.store.object_path(dataset["a"].digest)).unlink()
    assert "not readable" in repr(tacpipe.open("data/odd"))  # Looking at a damaged dataset is no error.


def test_a_dataset_and_a_recording_can_be_pickled(four: Dataset) -> None:
    part = pickle.loads(pickle.dumps(four.select(object="cup")))
    assert [recording.name for recording in part] == ["trial-000", "trial-002"] and part.path == four.path
    recording = pickle.loads(pickle.dumps(four["trial-001"]))
    assert recording.table().equals(four["trial-001"].table()) and recording.attributes == four["trial-001"].attributes


# ---- windows


def oracle(table: pa.Table, context: int, horizon: int, stride: int) -> list[int]:
    """Return the first rows of windows, looked for one by one."""
    t_ns, force = table["t_ns"].to_numpy(), table["arm_force_n"].to_numpy()
    bad = table["left_gap"].to_numpy() | ~np.isfinite(force)
    starts, run = [], 0
    for row in range(len(t_ns)):
        if bad[row] or (row and (bad[row - 1] or t_ns[row] - t_ns[row - 1] > 1.5 * STEP_NS)):
            run = row + bad[row]
        if not bad[row] and (row - run) % stride == 0:
            rows = range(row, row + context + horizon)
            complete = rows[-1] < len(t_ns) and not bad[list(rows)].any()
            if complete and (np.diff(t_ns[list(rows)]) < 1.5 * STEP_NS).all():
                starts.append(row)
    return starts


@pytest.mark.parametrize(("context", "horizon", "stride"), [(2, 1, 1), (3, 2, 2), (6, 6, 1), (1, 1, 5)])
def test_windows_are_those_of_one_recording_without_a_gap_a_late_row_or_a_missing_value(
    lab: Lab, context: int, horizon: int, stride: int
) -> None:
    tables = {
        "whole": synchronized_table(),
        "gap": synchronized_table(gap=5),
        "late": synchronized_table(late=7),
        "nan": synchronized_table(nan=3),
        "short": synchronized_table(2),
    }
    dataset = publish(lab, "data/w", {name: {"": table} for name, table in tables.items()})
    windows = dataset.windows(context, horizon, stride=stride)
    expected = [(name, row) for name in sorted(tables) for row in oracle(tables[name], context, horizon, stride)]
    assert len(windows) == len(expected) and windows.columns == ("left_x", "arm_force_n")
    for index, (name, row) in enumerate(expected):
        window = windows[index]
        assert window["recording"] == name
        rows = tables[name].slice(row, context + horizon)
        assert window["t_ns"].tolist() == rows["t_ns"].to_pylist() and window["t_ns"].dtype == torch.int64
        values = torch.cat([window["past"], window["future"]])
        assert values.tolist() == [
            list(pair) for pair in zip(*(rows[n].to_pylist() for n in windows.columns), strict=True)
        ]
        assert window["past"].shape == (context, 2) and window["past"].dtype == torch.float32
    with pytest.raises(IndexError):
        windows[len(expected)]


def test_windows_go_through_a_loader_in_worker_processes_and_read_nothing_before(four: Dataset) -> None:
    read: list[str] = []
    reader = four._read
    counted = Dataset(four.source, lambda name, path: read.append(path) or reader(name, path))  # type: ignore[func-returns-value]
    lazy = counted.windows(2, 1)
    assert not read and len(lazy) == 40 and len(read) == 4
    assert [lazy[n]["recording"] for n in (0, 39, 0)] == ["trial-000", "trial-003", "trial-000"] and len(read) == 4

    windows = four.windows(2, 1, columns=["arm_force_n", "left_x"], dtype="float64")
    sent = pickle.loads(pickle.dumps(windows))
    assert len(sent) == len(windows) == 40 and sent.columns == ("arm_force_n", "left_x")
    loader = torch.utils.data.DataLoader(windows, batch_size=16, num_workers=2, multiprocessing_context="forkserver")
    batches = list(loader)
    assert [len(batch["recording"]) for batch in batches] == [16, 16, 8]
    assert batches[0]["past"].shape == (16, 2, 2) and batches[0]["past"].dtype == torch.float64
    assert torch.cat([batch["t_ns"] for batch in batches]).shape == (40, 3)


@pytest.mark.parametrize("kept_bytes", [1 << 30, 100])
def test_several_windows_at_once_are_those_one_by_one_in_memory_and_in_a_file(
    four: Dataset, kept_bytes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = [four.windows(2, 1, inputs=["arm_*"], scale=True)[index] for index in (3, 39, -1, 3, 20)]
    monkeypatch.setattr("tacpipe.datasets.windows.KEPT_BYTES", kept_bytes)
    windows = four.windows(2, 1, inputs=["arm_*"], scale=True)
    for window, one in zip(windows.__getitems__([3, 39, -1, 3, 20]), expected, strict=True):
        assert window["recording"] == one["recording"]
        for name in ("past", "future", "t_ns"):
            assert torch.equal(window[name], one[name])
    with pytest.raises(IndexError, match="none has the index 40"):
        windows.__getitems__([0, 40])


def test_windows_separate_inputs_and_targets_by_names_and_patterns(four: Dataset) -> None:
    windows = four.windows(2, 1, inputs=["arm_*", "left_?"], targets=["left_x"])
    assert (windows.inputs, windows.targets) == (("arm_force_n", "left_x"), ("left_x",))
    assert windows.columns == ("arm_force_n", "left_x")
    window = windows[3]
    assert window["past"].tolist() == [[1.5, 3.0], [2.0, 4.0]]
    assert window["future"].tolist() == [[5.0]]
    assert four.windows(2, 1, targets=["left_*"]).inputs == ("left_x", "arm_force_n")  # masks match no pattern
    assert four.windows(2, 1, columns=["*_x"]).columns == ("left_x",)  # Ground truth matches no pattern either.
    with pytest.raises(tacpipe.UsageError, match=r"right_\*.*left_x"):
        len(four.windows(2, 1, inputs=["right_*"]))
    with pytest.raises(tacpipe.UsageError, match="columns"):
        four.windows(2, 1, columns=["left_x"], inputs=["left_x"])


def test_windows_subtract_the_level_at_rest_of_tactile_channels(four: Dataset) -> None:
    windows = four.windows(2, 1, rest_s=0.08)  # rows 0 to 4, whose median is 2
    assert windows[0]["past"].tolist() == [[-2.0, 0.0], [-1.0, 0.5]]
    with pytest.raises(tacpipe.UsageError, match="tactile"):
        len(four.windows(2, 1, columns=["arm_*"], rest_s=0.08))
    with pytest.raises(tacpipe.UsageError, match="rest_s"):
        four.windows(2, 1, rest_s=0)


def test_windows_are_scaled_by_the_rows_that_they_hold_or_as_others_are(lab: Lab) -> None:
    # the last row of a and the first of b are in no window
    tables = {"a": synchronized_table(nan=11), "b": synchronized_table(7, gap=0)}
    dataset = publish(lab, "data/w", {name: {"": table} for name, table in tables.items()})
    rows = np.concatenate([np.arange(11.0), np.arange(1, 7.0)])  # Values of left_x.
    windows = dataset.windows(2, 1, inputs=["left_x"], targets=["arm_force_n"], scale=True, dtype="float64")
    np.testing.assert_allclose(windows[4]["past"][:, 0], (np.array([4, 5]) - rows.mean()) / rows.std())
    np.testing.assert_allclose(windows[4]["future"][0], (6 / 2 - rows.mean() / 2) / (rows.std() / 2))
    np.testing.assert_allclose(windows.unscaled(windows[4]["future"]), [[3.0]])
    rescaled = dataset.select("b").windows(2, 1, columns=["left_x"], scale=windows, dtype="float64")
    np.testing.assert_allclose(rescaled[0]["past"][:, 0], (np.array([1, 2]) - rows.mean()) / rows.std())
    sent = pickle.loads(pickle.dumps(rescaled))
    assert torch.equal(sent[0]["past"], rescaled[0]["past"])
    with pytest.raises(tacpipe.UsageError, match="not scaled"):
        dataset.windows(2, 1, scale=dataset.windows(2, 1))[0]
    with pytest.raises(tacpipe.UsageError, match="arm_force_n"):
        dataset.windows(2, 1, scale=dataset.windows(2, 1, columns=["left_x"], scale=True))[0]


def test_windows_refuse_unlike_channels_and_integers_that_they_would_round(lab: Lab) -> None:
    long = pa.table({"t_ns": [0, 1, 2], "x": [1 << 24, (1 << 24) + 1, 0]})
    long_dataset = publish(lab, "data/long", {"a": {"": long}})
    with pytest.raises(tacpipe.UsageError, match="float64"):
        len(long_dataset.windows(1, 1))
    assert long_dataset.windows(1, 1, dtype="float64")[0]["future"].tolist() == [[float((1 << 24) + 1)]]
    two = publish(lab, "data/unlike", {"a": {"": long}, "b": {"": pa.table({"t_ns": [0, 1], "y": [1.0, 2.0]})}})
    with pytest.raises(tacpipe.UsageError, match="b "):
        len(two.windows(1, 1, dtype="float64"))
    for wrong in ((0, 1), (1, -1)):
        with pytest.raises(tacpipe.TacpipeError):
            two.windows(*wrong)
