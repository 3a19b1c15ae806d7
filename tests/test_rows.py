"""Every stage accounts for each row that it reads: it was used, or is counted under the reason why it was not."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tacpipe.datasets.dataset import Recording
from tacpipe.engine import execution
from tacpipe.engine.execution import ScratchStore
from tacpipe.engine.keys import WorkerTask
from tacpipe.errors import TacpipeError
from tacpipe.io.parquet import from_parquet, to_parquet
from tacpipe.plugins import registry
from tacpipe.plugins.rows import LATE, MERGED, OUTSIDE, RowCounts, StageRows
from tacpipe.store.location import open_store
from tests.conftest import Lab
from tests.promises.operations_cases import CASES

MAKES, READS_NO_ROWS = "it makes recordings and reads none", "it reads labels and files of results, and no rows"
EXEMPT = {  # stages that need not account for rows, and why
    **dict.fromkeys(("simulate.forward", "simulate.gel", "simulate.material", "simulate.touch"), MAKES),
    **dict.fromkeys(("split", "report"), READS_NO_ROWS),
}
# streams that are opened for their schema or their labels, while the rows of other streams are used
LABELS_ONLY = {"train.slip": {"events", "robot", "proximity", "truth", "plan"}}
LEARNING = ("train", "evaluate", "calibrate", "recentre", "compress", "extract", "predict")
STAGES = [name for name in registry.stages() if name not in EXEMPT]


@contextmanager
def opened_streams(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[tuple[str, str], int]]:
    """Collect the number of rows of each stream that is opened in the block, by recording and stream."""
    opened: dict[tuple[str, str], int] = {}
    with monkeypatch.context() as patch:
        for method in ("table", "columns"):
            patch.setattr(Recording, method, noting(getattr(Recording, method), opened))
        yield opened


def noting(open_stream: Callable[..., Any], opened: dict[tuple[str, str], int]) -> Callable[..., Any]:
    """Return a method that opens a stream and adds its number of rows to ``opened``."""

    def open_and_note(self: Recording, stream: str = "", *selected: Any, **named: Any) -> Any:
        table = open_stream(self, stream, *selected, **named)
        if stream in self.streams:
            opened[self.name, stream] = table.num_rows
        return table

    return open_and_note


def check_counts(task: WorkerTask, opened: Mapping[tuple[str, str], int], result: Any, counts: Any) -> None:
    """Check the counts of a task against the rows that it opened, or the rows that it stored if it read files."""
    stage = registry.load_step(task.name)
    if stage.source:
        stored = {stream: shard["rows"] for stream, shard in result["recordings"][""]["shards"].items()}
        assert {stream: rows.used for stream, rows in counts.items() if rows.used} == {
            stream: rows for stream, rows in stored.items() if rows
        }
        return
    if stage.argument("Parts"):  # the rows of the recordings are counted by the parts
        return
    assert counts is not None, f"{task.name} does not state which rows it used"
    read = Counter[str]()
    for (_, stream), rows in opened.items():
        read[stream] += rows
    labels = LABELS_ONLY.get(task.name, set())
    assert {stream: counts[stream].read for stream in counts} == {
        stream: rows for stream, rows in read.items() if stream in counts or stream not in labels
    }, task.name


def perturbed(table: pa.Table, rng: np.random.Generator, *, merged: bool) -> pa.Table:
    """Return a stream with random rows missing and, if ``merged``, random stamps equal to the one before."""
    if table.num_rows < 20 or "t_ns" not in table.column_names:
        return table
    missing = rng.choice([0.0, 0.02, 0.3])
    kept = rng.random(table.num_rows) >= missing
    kept[: rng.integers(0, 5)] = False
    table = table.filter(pa.array(kept))
    if not merged:
        return table
    t_ns = table.column("t_ns").to_numpy().copy()
    sources = np.where(rng.random(len(t_ns)) < rng.choice([0.0, 0.1, 0.8]), 0, np.arange(len(t_ns)))
    return table.set_column(0, table.schema.field("t_ns"), pa.array(t_ns[np.maximum.accumulate(sources)]))


def with_random_rows(task: WorkerTask, seed: int) -> WorkerTask:
    """Return the task with random rows of its recordings, which are put into the store."""
    store, rng = open_store(task.store), np.random.default_rng(seed)
    kinds = registry.load_step(task.name).arguments

    def change(value: Any) -> Any:
        if "shards" in value:
            shards = {}
            for stream, shard in value["shards"].items():
                table = from_parquet(store.read(shard["digest"]))
                changed = perturbed(table, rng, merged=task.name == "synchronize" and table.schema.names[0] == "t_ns")
                shards[stream] = {"digest": store.put(to_parquet(changed)).digest}
            return {**value, "shards": shards}
        return {**value, "recordings": {name: change(entry) for name, entry in value["recordings"].items()}}

    inputs = {
        name: change(value) if kinds.get(name) in ("Recording", "Dataset") and value else value
        for name, value in task.identity["inputs"].items()
    }
    return replace(task, identity={**task.identity, "inputs": inputs}, run="")


@pytest.mark.parametrize("name", STAGES)
def test_a_stage_counts_every_row_that_it_reads_of_random_recordings(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    case, execute, tasks = CASES[name], execution.execute, dict[str, WorkerTask]()

    def checking(task: WorkerTask, *arguments: Any, **named: Any) -> Any:
        tasks.setdefault(task.name, task)
        with opened_streams(monkeypatch) as opened:
            executed = execute(task, *arguments, **named)
        if registry.stage_name(task.name) not in EXEMPT:
            check_counts(task, opened, executed[0], executed[2] and executed[2].streams)
        return executed

    monkeypatch.setenv("TACPIPE_JOBS", "1")
    case.sources(lab.folder)
    for command in case.before:
        lab.run(command)
    case.spoil(lab.folder)
    monkeypatch.setattr(execution, "execute", checking)
    lab.run(case.command)
    ran = [task for task in tasks.values() if registry.stage_name(task.name) == name]
    assert ran, f"{case.command} does not run {name}"

    @settings(
        max_examples=1 if name.startswith(LEARNING) else 5, deadline=None, suppress_health_check=list(HealthCheck)
    )
    @given(seed=st.integers(0, 2**32 - 1))
    def run_with_random_rows(seed: int) -> None:
        for task in ran:
            if not registry.load_step(task.name).source:
                changed = with_random_rows(task, seed)
                try:
                    checking(changed, open_store(task.store), ScratchStore(), followed=False)
                except TacpipeError as error:  # some stages refuse gaps, or recordings without contact
                    assert "does not add up" not in str(error)

    run_with_random_rows()


def test_counts_that_do_not_add_up_are_refused() -> None:
    for read, used, unused in ((3, 1, {LATE: 1}), (3, 4, {LATE: -1}), (-1, -1, {})):
        with pytest.raises(TacpipeError, match="does not add up"):
            RowCounts(read, used, unused)


counts_of_streams = st.dictionaries(
    st.sampled_from(["", "arm", "skin"]),
    st.builds(
        lambda used, unused: RowCounts(used + sum(unused.values()), used, unused),
        st.integers(0, 1000),
        st.dictionaries(st.sampled_from([LATE, MERGED, OUTSIDE]), st.integers(0, 50)),
    ),
)


@given(first=counts_of_streams, second=counts_of_streams)
def test_rows_of_results_add_up_and_can_be_subtracted_and_stored(
    first: dict[str, RowCounts], second: dict[str, RowCounts]
) -> None:
    total = StageRows()
    for rows in (first, second):
        total.add(StageRows(1, dict(rows)))
    read = [sum(counts.read for counts in rows.values()) for rows in (first, second)]
    assert sum(counts.read for counts in total.streams.values()) == sum(read)
    restored = StageRows.from_json(total.to_json())
    assert restored == total
    restored.subtract(StageRows(1, second))
    assert restored.results == 1
    assert {stream: counts for stream, counts in restored.streams.items() if counts.read} == {
        stream: counts for stream, counts in first.items() if counts.read
    }


def test_rows_outside_the_common_time_are_mentioned_from_one_percent() -> None:
    few, many = (StageRows(1, {"arm": RowCounts(1000, 1000 - rows, {OUTSIDE: rows})}) for rows in (9, 10))
    assert few.describe_unused("synchronize") == ""
    assert (
        many.describe_unused("synchronize")
        == "synchronize used 990 of 1,000 rows; 10 outside the common time (arm 10)."
    )
    late = StageRows(1, {"arm": RowCounts(10_000, 9_999, {LATE: 1})})
    assert late.describe_unused("synchronize") == "synchronize used 9,999 of 10,000 rows; 1 late (arm 1)."


def test_a_command_prints_unused_rows_also_on_a_hit_and_show_has_them_by_stream(lab: Lab) -> None:
    lab.run("simulate touch --raw --trials 1 -o data/pinched")
    printed = [lab.run("segment grasps data/pinched -o data/grasps").err for _ in range(2)]
    sentences = [line for text in printed for line in text.splitlines() if "segment.grasps used" in line]
    assert len(sentences) == 2 and len(set(sentences)) == 1 and "not of the object (scene " in sentences[0]
    streams = lab.run_json("show data/grasps")["counted"]["stages"]["segment.grasps"]["streams"]
    (pinched,) = lab.run_json("show data/pinched")["recordings"].values()
    assert {stream: rows["read"] for stream, rows in streams.items()} == {
        stream: figures["rows"] for stream, figures in pinched.items()
    }
    assert "outside the reading" in lab.run("show data/grasps").out


def test_results_without_counts_are_said_not_to_be_counted(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.run("simulate toy --trials 2 -o data/r")
    with monkeypatch.context() as older:
        older.setattr(execution, "_counted_rows", lambda *_: None)
        lab.run("scale data/r -o data/s --jobs 1")
    assert "rows read: not counted for 2 results" in lab.run("show data/s").out
    lab.run("simulate toy --trials 3 -o data/r")
    lab.run("scale data/r -o data/s --jobs 1")
    counted = lab.run_json("show data/s")["counted"]
    assert counted["uncounted"] == 2
    streams = {"left": {"read": 20, "used": 20, "unused": {}}}
    assert counted["stages"]["scale"] == {"results": 1, "streams": streams}
