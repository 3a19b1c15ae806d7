"""A lab's folder of recordings, from a guessed layout to the reports of both tasks, by commands alone."""

import json
import re
from pathlib import Path

import pytest

from tests import lab_recordings
from tests.conftest import Lab

ANSWERS = {  # Answers of a user who knows the rig: the line that has it, and what replaces its "?".
    r'match = "[xyz]"': {"quantity": "position", "unit": "m"},
    r'match = "t\{taxel\}"': {"quantity": "tactile", "unit": "count"},
    r"^sensor = ": {"sensor": "lab-array"},
}


def answer_guess(guess: str) -> str:
    """Return a guessed layout with each "?" replaced, and nothing else changed."""
    lines = guess.splitlines()
    for at, line in enumerate(lines):
        for pattern, values in ANSWERS.items():
            if re.search(pattern, line):
                for name, value in values.items():
                    lines[at] = lines[at].replace(f'{name} = "?"', f'{name} = "{value}"')
    return "\n".join(lines)


def ingest_recordings(lab: Lab, count: int, seconds: float) -> None:
    """Write recordings of a lab and read them into ``data/recordings`` with the layout that is guessed for them."""
    lab_recordings.write(lab.folder / "lab", count, seconds)
    guess = lab.run("ingest table lab --guess").out
    Path("layout.toml").write_text(answer_guess(guess))
    assert '"?"' not in Path("layout.toml").read_text().partition("[streams")[2]
    lab.run("ingest table lab --layout layout.toml -o data/recordings")


def test_a_lab_s_folder_is_synchronized_and_segmented_with_a_guessed_layout(lab: Lab) -> None:
    ingest_recordings(lab, 2, 3.0)
    lab.run("synchronize data/recordings -o data/synced")
    lab.run("segment contacts data/synced -o data/segments")
    lab.run("segment slides data/recordings -o data/slides --trigger load --frames 50")
    assert {entry["attributes"]["material"] for entry in lab.manifest("data/slides").recordings.values()} == {
        "cork",
        "foam",
    }


@pytest.mark.long
def test_a_lab_s_folder_gives_a_report_of_forecasts_and_one_of_materials_without_a_line_of_python(lab: Lab) -> None:
    ingest_recordings(lab, 20, 8.0)
    lab.run("synchronize data/recordings -o data/synced")
    lab.run("segment contacts data/synced -o data/segments")
    lab.run("split data/segments -o data/split --scheme random --test 0.4")
    lab.run("train forward data/segments --split data/split -o models/forward --hidden 64")
    lab.run("compress pca data/segments --split data/split -o data/latents")
    forward = json.loads(
        lab.run("evaluate models/forward data/segments --split data/split -o results/forward --json").out
    )
    lab.run("report results/forward -o forward.html")

    lab.run("segment slides data/recordings -o data/slides --trigger load")
    lab.run("split data/slides -o data/slides-split --scheme random --stratify material --test 0.4 --val 0")
    lab.run("train material data/slides --split data/slides-split -o models/material")
    material = json.loads(
        lab.run("evaluate models/material data/slides --split data/slides-split -o results/material --json").out
    )
    lab.run("report results/material -o material.html")

    (first,) = forward["headline"]
    assert first["best_baseline"] and first["clusters"] == 8
    metrics = json.loads(Path("results/forward/metrics.json").read_text())
    # Rows are 10 ms apart. Ridge follows the smooth load of this rig better at first, the network from the plan later.
    ahead = {name: metrics[name]["mae_counts"]["both"] for name in ("model", "ridge", "ridge_actions")}
    assert ahead["model"]["t10"] < 0.7 * min(ahead["ridge"]["t10"], ahead["ridge_actions"]["t10"])
    assert metrics["skill"]["mse_counts"]["mean"]["low"] > 0.5  # over persistence
    (second,) = material["headline"]
    assert second["low"] > 0 and second["model"]["values"][0] > 50
    config = json.loads(Path("models/forward/config.json").read_text())
    assert config["architecture"] == "taxelwise" and config["inputs"]["pose"]["position"] == ["arm_x", "arm_y", "arm_z"]
    assert set(lab_recordings.PERIODS_M) <= set(re.findall(r"\w+", Path("results/material/confusion.csv").read_text()))
    for page in ("forward.html", "material.html"):
        assert "<svg" in Path(page).read_text()
