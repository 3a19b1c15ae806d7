"""LeRobot datasets as pyarrow and json read them; LeRobot's own loader reads them in `tests.exports.test_other_tools`."""

import json
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

import tacpipe
from tests.conftest import Lab
from tests.exports import recordings

EXPORT = "export lerobot rec -o lr --rate-hz 100 --actions arm --task 'press the {object}'"


def info() -> Any:
    with open("lr/meta/info.json") as file:
        return json.load(file)


def test_frames_hold_what_synchronize_gives_under_lerobot_s_names(rig: Lab) -> None:
    rig.run(EXPORT)
    rig.run("synchronize rec -o sync --rate-hz 100")
    provided = tacpipe.open("sync")
    frames = pq.read_table("lr/data/chunk-000/file-000.parquet")
    features = info()["features"]
    start = 0
    for episode, entry in enumerate(provided):
        table = entry.table()
        mine = frames.slice(start, table.num_rows)
        assert set(mine["episode_index"].to_pylist()) == {episode}
        assert mine["index"].to_pylist() == list(range(start, start + table.num_rows))
        np.testing.assert_allclose(mine["timestamp"].to_numpy(), np.arange(table.num_rows) / 100, atol=1e-6)
        np.testing.assert_array_equal(mine["tacpipe.t_ns"].to_numpy(), table["t_ns"].to_numpy())
        for feature, stream in (("observation.state", "arm"), ("observation.tactile.skin", "skin")):
            values = np.array(mine[feature].to_pylist(), np.float32)
            for position, name in enumerate(features[feature]["names"]):
                expected = table[f"{stream}_{name}"].to_numpy()
                with np.errstate(over="ignore"):
                    np.testing.assert_array_equal(values[:, position], expected.astype(np.float32))
        state, action = (np.array(mine[name].to_pylist()) for name in ("observation.state", "action"))
        np.testing.assert_array_equal(action[:-1], state[1:])
        np.testing.assert_array_equal(mine["tacpipe.gap.skin"].to_numpy(), table["skin_gap"].to_numpy())
        start += table.num_rows
    assert (info()["total_frames"], info()["total_episodes"], info()["fps"]) == (start, 2, 100)


def test_the_task_is_the_recording_s_label_and_every_label_is_with_its_episode(rig: Lab) -> None:
    rig.run(EXPORT)
    tasks = pd.read_parquet("lr/meta/tasks.parquet")
    assert tasks["task_index"].to_dict() == {"press the box": 0, "press the cup": 1}
    episodes = pq.read_table("lr/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [episode["tasks"] for episode in episodes] == [["press the box"], ["press the cup"]]
    assert [episode["tacpipe/recording"] for episode in episodes] == ["trial-00", "trial-01"]
    assert [json.loads(episode["tacpipe/attributes"]) for episode in episodes] == [
        recordings.trial(0)[1],
        recordings.trial(1)[1],
    ]
    err = rig.call("export lerobot rec -o lr --rate-hz 100 --task 'press the {colour}'").err
    assert "colour" in err


@pytest.mark.long
def test_statistics_are_those_of_the_frames(rig: Lab) -> None:
    rig.run(EXPORT)
    frames = pq.read_table("lr/data/chunk-000/file-000.parquet")
    with open("lr/meta/stats.json") as file:
        stats = json.load(file)
    values = np.array(frames["observation.tactile.skin"].to_pylist(), float)
    result = stats["observation.tactile.skin"]
    for name in ("min", "max", "mean", "std"):
        np.testing.assert_allclose(result[name], getattr(values, name)(axis=0), rtol=1e-9)
    assert result["count"] == [len(values)]
    assert result["q01"] < result["q10"] < result["q50"] < result["q90"] < result["q99"]
    numbers = {name for name, value in info()["features"].items() if value["dtype"] != "string"}
    assert set(stats) == numbers


def test_the_recorded_shards_lie_beside_the_frames_byte_for_byte(rig: Lab) -> None:
    rig.run(EXPORT)
    for path in (rig.folder / "rec").glob("*/*.parquet"):
        assert (rig.folder / "lr/tacpipe" / path.parent.name / path.name).read_bytes() == path.read_bytes()
    rig.run("export lerobot rec -o bare --rate-hz 100 --no-originals")
    assert not (rig.folder / "bare/tacpipe").exists()


@pytest.mark.long
def test_only_measured_channels_are_observations_and_touch_joins_the_state_if_asked(rig: Lab) -> None:
    rig.run(EXPORT)
    names = [name for name in info()["features"] if name.startswith("observation.")]
    assert sorted(names) == ["observation.odd", "observation.state", "observation.tactile.skin"]
    rig.run(EXPORT + " --tactile-in-state")
    state = info()["features"]["observation.state"]
    assert state["shape"] == [13 + 6]
    assert state["names"][-1] == "skin_taxel02_z"


def test_what_is_lost_is_listed(rig: Lab) -> None:
    err = rig.run(EXPORT).err
    lost = [line for line in err.splitlines() if "not carried" in line]
    assert any("float32" in line and "arm" in line for line in lost)
    assert any("rate" in line for line in lost)
    readme = (rig.folder / "lr/README.md").read_text()
    assert all(line.partition("not carried: ")[2] in readme for line in lost)


@pytest.mark.parametrize("options", ["", "--rate-hz 100 --actions leg", "--rate-hz 100 --state leg"])
def test_what_cannot_be_made_is_refused(rig: Lab, options: str) -> None:
    ran = rig.call(f"export lerobot rec -o lr {options}")
    assert ran.code != 0
    assert "--rate-hz" in ran.err if not options else "leg" in ran.err
    assert not (rig.folder / "lr").exists()


def test_an_episode_of_more_frames_than_memory_takes_at_once_has_the_same_frames(
    rig: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.run(EXPORT)
    expected = pq.read_table("lr/data/chunk-000/file-000.parquet")
    monkeypatch.setattr("tacpipe.exports.lerobot.GROUP_FRAMES", 7)
    rig.run(EXPORT.replace("-o lr", "-o pieces") + " --rerun")
    path = "pieces/data/chunk-000/file-000.parquet"
    assert pq.read_table(path).equals(expected)
    assert pq.ParquetFile(path).num_row_groups > 2
