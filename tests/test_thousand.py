"""Many recordings, of which one changes: what has to be done again in each stage of the chain."""

import json
from pathlib import Path

import pytest

import tacpipe
from tacpipe.datasets import directory
from tacpipe.datasets.manifest import Manifest
from tacpipe.store.records import RecordingEntry
from tacpipe.store.store import Store
from tests.conftest import tacpipe as command

MANY = [pytest.param(100, marks=pytest.mark.long), pytest.param(1000, marks=pytest.mark.faults)]
STAGES = {
    "synchronize": "synchronize data/recordings -o data/synced --rate-hz 25",
    "segment": "segment contacts data/synced -o data/segments",
    "encode": "compress pca data/segments --split data/split -o data/latents --components 4",
}


def outcome(folder: Path, words: str) -> tuple[int, int]:
    process = command(folder, f"{words} --json")
    assert process.returncode == 0, process.stderr
    value = json.loads(process.stdout)
    return value["ran"], value["reused"]


@pytest.fixture(scope="module", params=MANY)
def recordings(request: pytest.FixtureRequest) -> int:
    number: int = request.param
    return number


@pytest.fixture(scope="module")
def lab(recordings: int, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("many")
    (folder / ".tacpipe").mkdir()
    simulate = "simulate forward --duration-s 4 --tactile-rate-hz 25 --robot-rate-hz 50"
    assert outcome(folder, f"{simulate} --trials {recordings} -o data/recordings") == (recordings, 0)
    assert outcome(folder, f"{simulate} --trials 1 --seed 1 -o data/other") == (1, 0)
    assert outcome(folder, STAGES["synchronize"]) == (recordings, 0)
    assert outcome(folder, STAGES["segment"]) == (recordings, 0)
    assert outcome(folder, "split data/segments -o data/split --scheme random") == (1, 0)
    assert outcome(folder, STAGES["encode"]) == (recordings, 0)
    return folder


def record_anew(folder: Path, name: str, entry: RecordingEntry) -> None:
    """Give one recording other streams, and the dataset's directory with it."""
    before = tacpipe.open(folder / "data/recordings").source
    changed = Manifest(before.stage, before.version, before.params, recordings={**before.recordings, name: entry})
    store = Store(folder / ".tacpipe")
    changed.keep(store)
    directory.publish(store, changed, folder / "data/recordings")


def test_one_changed_recording_costs_one_shard_in_every_stage(lab: Path, recordings: int) -> None:
    split = tacpipe.open(lab / "data/split").to_pandas()
    name = str(split["recording"][split["role"] == "test"].iloc[0])
    entry = tacpipe.open(lab / "data/other").source.recordings["trial-000"]
    record_anew(lab, name, entry)
    for stage, words in STAGES.items():
        assert outcome(lab, words) == (1, recordings - 1), stage


def test_a_recording_made_anew_with_equal_bytes_costs_nothing(lab: Path, recordings: int) -> None:
    entry = tacpipe.open(lab / "data/recordings").source.recordings["trial-007"]
    attributes = {**entry["attributes"], "note": "recorded again"}
    record_anew(lab, "trial-007", {**entry, "attributes": attributes})
    for stage, words in STAGES.items():
        assert outcome(lab, words) == (0, recordings), stage
