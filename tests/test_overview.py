"""`tacpipe show` and `tacpipe evaluate` print models, results, splits and recordings."""

import json
import math
import sys
from pathlib import Path
from typing import Any

import pytest

from tacpipe.cli import headline_table
from tacpipe.io import terminal
from tacpipe.scores import headline, words
from tests import chain
from tests.conftest import tacpipe

EVALUATE = next(command for command in chain.CHAIN if command.startswith("evaluate"))


@pytest.fixture(scope="module")
def lab(chained: Path) -> Path:
    return chained


def show(folder: Path, arguments: str) -> tuple[str, dict[str, Any]]:
    """Return what `tacpipe show` prints as text and as JSON."""
    text, value = (tacpipe(folder, f"show {arguments}{option}") for option in ("", " --json"))
    assert (text.returncode, value.returncode) == (0, 0), text.stderr
    parsed: dict[str, Any] = json.loads(value.stdout)
    return text.stdout, parsed


def row(text: str, name: str) -> str:
    """Return the text after a name."""
    (line_of_name,) = [line for line in text.splitlines() if line.startswith(f"{name} ")]
    return line_of_name.removeprefix(name).strip()


def test_a_model_is_shown_by_what_it_is_and_what_it_was_trained_on(lab: Path) -> None:
    text, value = show(lab, "models/forward")
    config = json.loads((lab / "models/forward/config.json").read_text())
    assert value["kind"] == "model"
    assert (row(text, "task"), row(text, "architecture")) == ("forward", "gru")
    train, val = config["counts"]["train"], config["counts"]["val"]
    assert row(text, "trained on") == f"train: recordings {train['recordings']}, windows {train['windows']}"
    assert f"val: recordings {val['recordings']}, windows {val['windows']}" in text
    assert value["trained_on"]["recordings"] == len(config["trained_on"])
    assert row(text, "context") == "10" and "PCA" in row(text, "codec")
    assert f"loss {config['validation']['loss']:.6g}" in row(text, "validation")
    assert row(text, "epochs") == "2"
    assert "segment.contacts" in row(text, "behind") and "data/latents [" in row(text, "datasets")
    assert "recording  " not in text and "gt_" not in text


def test_the_parameters_of_a_model_are_counted_in_its_weights(lab: Path) -> None:
    from safetensors.numpy import load_file

    expected = sum(math.prod(tensor.shape) for tensor in load_file(lab / "models/forward/model.safetensors").values())
    assert show(lab, "models/forward")[1]["parameters"] == expected


def test_a_result_is_shown_by_its_headline_its_baselines_and_what_it_rests_on(lab: Path) -> None:
    text, value = show(lab, "results/forward")
    headlines = headline.read((lab / "results/forward/headline.json").read_bytes())
    assert value["kind"] == "result"
    assert text.startswith(headline_table.text(headlines, terminal.width_of(sys.stdout)))
    assert value["headline"] == [part.to_json() for part in headlines]
    assert value["baselines"] == [baseline.name for baseline in headlines[0].baselines]
    assert "ridge" in row(text, "baselines") and "codec" not in row(text, "baselines")
    counts = json.loads((lab / "results/forward/metrics.json").read_text())["counts"]
    assert f"recordings {counts['recordings']}" in row(text, "evaluated on")
    assert row(text, "role") == "test, fold 0"
    assert "models/forward [" in row(text, "model")
    assert "gt_" not in text


def test_a_result_of_before_headlines_says_so() -> None:
    from tacpipe.cli import model_overview

    value: model_overview.ResultOverview = {
        "headline": None,
        "task": "t",
        "architecture": "a",
        "evaluated_on": {"n": 3},
        "by_part": {},
        "role": None,
        "fold": None,
        "params": {},
        "baselines": [],
        "trained_on": {"roles": {}, "recordings": None},
        "inputs": {},
    }
    assert "run `tacpipe evaluate` again" in model_overview.to_text(value)[0]


def test_a_split_is_shown_by_how_many_recordings_have_each_role(lab: Path) -> None:
    text, value = show(lab, "data/split")
    assert value["kind"] == "split"
    assert text.splitlines()[0].split() == ["fold", "train", "val", "test"]
    counts = value["folds"]["0"]
    assert text.splitlines()[1].split() == ["0", *(str(counts[role]) for role in ("train", "val", "test"))]
    assert sum(counts.values()) == 8


def test_the_truth_of_a_simulator_takes_one_line(lab: Path) -> None:
    text, value = show(lab, "data/recordings")
    assert value["kind"] == "recordings"
    assert [line for line in text.splitlines() if line.startswith("gt_")] == [
        "gt_*: 13 labels with the simulator's ground truth (--full lists them)"
    ]
    full = tacpipe(lab, "show data/recordings --full").stdout
    assert sum(line.startswith("gt_") for line in full.splitlines()) == 13
    assert "gt_mass_kg" in next(iter(value["attributes"].values()))  # programs get it whole


def test_a_picture_hatches_the_padding_of_contacts(lab: Path, tmp_path: Path) -> None:
    for dataset in ("synced", "segments"):
        tacpipe(lab, f"show data/{dataset} trial-000 --plot {tmp_path}/{dataset}.svg")
    assert "<pattern" in (tmp_path / "segments.svg").read_text()
    assert "<pattern" not in (tmp_path / "synced.svg").read_text()


def test_evaluate_prints_its_headline_on_a_hit_too_and_stdout_is_the_output_alone(lab: Path) -> None:
    headlines = headline.read((lab / "results/forward/headline.json").read_bytes())
    table = headline_table.table(headlines, legend=False).text(terminal.width_of(sys.stderr))
    process = tacpipe(lab, EVALUATE)
    assert process.stdout == "results/forward\n"
    assert "0 ran" in process.stderr and table in process.stderr and words.sentence(headlines[0]) in process.stderr


def test_quiet_hides_the_headline_and_json_carries_it(lab: Path) -> None:
    quiet = tacpipe(lab, f"{EVALUATE} --quiet")
    assert (quiet.stdout, quiet.stderr) == ("results/forward\n", "")
    value = json.loads(tacpipe(lab, f"{EVALUATE} --quiet --json").stdout)
    read = headline.read((lab / "results/forward/headline.json").read_bytes())
    assert value["headline"] == [part.to_json() for part in read]


def test_a_page_says_of_a_result_what_the_terminal_says(lab: Path) -> None:
    import tacpipe as library
    from tacpipe.comparison import engine

    opened = library.open(lab / "results/forward")
    (compared,) = engine.compare([opened])
    page = compared.headline
    assert page is not None
    (printed,) = headline.read(opened.files[headline.FILE])
    assert headline_table.text([page]) == headline_table.text([printed])  # sums are kept to nine digits
    assert page.gain == pytest.approx(printed.gain) and page.verdict == printed.verdict


def test_other_commands_have_no_headline(lab: Path) -> None:
    process = tacpipe(lab, f"{next(command for command in chain.CHAIN if command.startswith('split'))} --json")
    assert "headline" not in json.loads(process.stdout)
