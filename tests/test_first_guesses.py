"""Test words that people type before they read: they work, or the error names what does the same."""

from collections.abc import Callable
from typing import Any

import pytest

import tacpipe
from tests.conftest import Lab

MADE = (
    "simulate forward --trials 3 --duration-s 4 -o data/r",
    "synchronize data/r -o data/s",
    "split data/s -o data/split",
)
WORKS: dict[str, Callable[[Any], Any]] = {
    "dataset[0]": lambda dataset: dataset[0].name == dataset[-3].name == "trial-000",
    "dataset[:2]": lambda dataset: dataset[:2].names == ["trial-000", "trial-001"],
    "dataset.streams": lambda dataset: "taxel01_x" in dataset.streams["xela1"],
    "recording[stream]": lambda dataset: dataset[0]["xela1"].attrs["units"]["taxel01_x"] == "count",
    "recording.to_pandas": lambda dataset: len(dataset[0].to_pandas("robot")) == dataset[0].rows["robot"],
    "the split is printed": lambda dataset: "3 columns" in repr(tacpipe.open("data/split")),
    "two words": lambda dataset: len(tacpipe.run("segment blocks", "data/s", output="data/b", parts=2)) == 6,
    "the names of the module": lambda dataset: not {"os", "Any", "annotations"} & set(dir(tacpipe)),
}
NAMED: dict[str, tuple[Callable[[Any], Any], str]] = {
    "dataset.head()": (lambda dataset: dataset.head(), r"to_pandas\(STREAM\)"),
    "dataset.columns": (lambda dataset: dataset.columns, "streams lists the columns"),
    "dataset.select(list)": (lambda dataset: dataset.select(list(dataset.recordings)), r"select\(\*names\)"),
    "dataset.filter": (lambda dataset: dataset.filter(object="cup"), "select"),
    "recording.plot()": (lambda dataset: dataset[0].plot(), "tacpipe show DATASET RECORDING --plot"),
    "recording.xela1": (lambda dataset: dataset[0].xela1, r"recording\['xela1'\]"),
    "recording.labels": (lambda dataset: dataset[0].labels, "attributes has the labels"),
    "tacpipe.read": (lambda dataset: tacpipe.read("data/r"), r"tacpipe.open\(PATH\)"),
    "tacpipe.load_model": (lambda dataset: tacpipe.load_model("models/m"), r"tacpipe.load\(PATH\)"),
    "tacpipe.synchronize": (lambda dataset: tacpipe.synchronize("data/r"), "tacpipe.run"),
}
TYPED = {
    "ingest lab -o d": "ingest table FOLDER --guess",
    "ingest csv lab -o d": "ingest table FOLDER --guess",
    "ingest bags lab": "ingest rosbag FOLDER",
    "segment data/s": "needs one of blocks, contacts",
    "train data/s": "needs one of classify, forward",
    "export xlsx data/s -o x": "needs one of card, csv",
    "plot data/r": "tacpipe show DATASET RECORDING --plot",
    "record rig.toml": "tacpipe acquire RIG",
    "ls": "tacpipe show DATASET",
    "run synchronize": "stages are commands",
    "remove data/r": "tacpipe store gc",
    "show data": "Give the directory that a tacpipe command wrote with -o, such as data/r.",
    "syncronize data/r": "Did you mean 'synchronize'?",
}


def test_first_guesses_in_python_work_or_name_what_does(lab: Lab) -> None:
    for command in MADE:
        lab.run(command)
    dataset = tacpipe.open("data/r")
    failed = [guess for guess, check in WORKS.items() if not check(dataset)]
    assert not failed
    for guess, (call, hint) in NAMED.items():
        with pytest.raises((AttributeError, tacpipe.UsageError), match=hint):
            call(dataset)
            pytest.fail(f"{guess} works")


@pytest.mark.parametrize("words", TYPED)
def test_a_first_guess_on_the_command_line_names_the_command(words: str, lab: Lab) -> None:
    (lab.folder / "data" / "r").mkdir(parents=True)
    (lab.folder / "data" / "r" / "manifest.json").write_text("{}")
    ran = lab.call(words)
    assert ran.code == 2
    assert TYPED[words] in " ".join(ran.err.split())
