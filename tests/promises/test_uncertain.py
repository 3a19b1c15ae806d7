"""Stages that are not deterministic, and inputs that change while they are read."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tacpipe.errors import DAMAGED, FAILED
from tacpipe.plugins import registry
from tests.conftest import forget, tacpipe, write_plugin
from tests.promises import damages, specimen
from tests.promises.counts import count
from tests.promises.specimen import CHAIN, Specimen

ENTRY_POINTS = """
[tacpipe.stages]
chance = uncertain_stages:chance
moment = uncertain_stages:moment
unordered = uncertain_stages:unordered
fitted = uncertain_stages:fitted
"""
UNCERTAIN = {
    "chance data/simulated": "trial-000.parquet; trial-001.parquet",
    "chance data/simulated --only trial-001": "trial-001.parquet",
    "moment data/scaled": "when.json",
    "fitted data/scaled --split data/split": "codec.json",
}


@pytest.fixture
def uncertain(project: Specimen, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Specimen:
    """A project in which a plug-in with stages that are not deterministic is installed."""
    folder = tmp_path_factory.mktemp("uncertain")
    shutil.copy(Path(__file__).parent / "plugin" / "uncertain_stages.py", folder)
    write_plugin(folder, "uncertain", ENTRY_POINTS)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")]))
    forget()
    return project


@pytest.mark.parametrize("command", UNCERTAIN)
def test_a_stage_that_gives_something_else_is_found_and_what_differs_is_named(
    uncertain: Specimen, command: str
) -> None:
    lab = uncertain.lab
    lab.run(f"{command} -o data/u --jobs 1")
    before = specimen.files(lab.folder / "data/u")
    compared = lab.call(f"{command} -o data/u --jobs 1 --recompute-and-compare")
    assert compared.code == FAILED and "Traceback" not in compared.err, compared
    differences = compared.err.partition("differ from what is stored: ")[2].strip()
    assert differences.startswith(UNCERTAIN[command]), compared
    assert specimen.files(lab.folder / "data/u") == before
    count("corruptions found")


def test_an_order_that_depends_on_the_process_is_found(uncertain: Specimen) -> None:
    command = "unordered data/scaled -o data/u"
    assert tacpipe(uncertain.folder, command, PYTHONHASHSEED="1").returncode == 0
    same = tacpipe(uncertain.folder, f"{command} --recompute-and-compare", PYTHONHASHSEED="1")
    assert same.returncode == 0, same.stderr
    other_seed = tacpipe(uncertain.folder, f"{command} --recompute-and-compare", PYTHONHASHSEED="2")
    assert other_seed.returncode == FAILED and "names.json" in other_seed.stderr


@pytest.mark.parametrize("command", CHAIN)
def test_deterministic_stages_pass(project: Specimen, command: str) -> None:
    ran = project.lab.call(f"{command} --recompute-and-compare")
    assert ran.code == 0 and "differ" not in ran.err
    assert project.data_files() == dict(project.sound)


def test_a_lost_shard_that_cannot_be_made_as_it_was_is_said_so_and_a_rerun_makes_new_ones(uncertain: Specimen) -> None:
    lab = uncertain.lab
    lab.run("chance data/simulated -o data/u --jobs 1")
    lost = lab.manifest("data/u").recordings["trial-001"]["shards"][""]["digest"]
    Path(lab.store.object_path(lost)).unlink()
    (lab.folder / "data/u/trial-001.parquet").unlink()
    failed = lab.call("total data/u -o data/v")
    assert failed.code == DAMAGED and "gave something else when it was run again" in failed.err, failed
    assert "trial-001.parquet" in failed.err and not (lab.folder / "data/v").exists()
    lab.run("chance data/simulated -o data/u --jobs 1")
    lab.run("total data/u -o data/v")
    assert lab.manifest("data/u").recordings["trial-001"]["shards"][""]["digest"] != lost


# ---- inputs that change while they are read


def after_stage_call(monkeypatch: pytest.MonkeyPatch, happens: Callable[[], None], times: int = 1) -> None:
    """Let something happen once a stage has been called, right after it returned."""
    honest = registry.load_step

    def load_step(name: str) -> Any:
        stage = honest(name)

        def call(*args: Any, **kwargs: Any) -> Any:
            nonlocal times
            returned = stage(*args, **kwargs)
            if times:
                times -= 1
                happens()
            return returned

        return _Calling(stage, call)

    monkeypatch.setattr(registry, "load_step", load_step)


class _Calling:
    """A stage that does something besides when it is called."""

    def __init__(self, stage: Any, call: Callable[..., Any]) -> None:
        self._stage, self._call = stage, call

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stage, name)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self._call(*args, **kwargs)


def test_a_file_that_changes_while_it_is_ingested_is_not_taken_and_a_rerun_is_right(
    project: Specimen, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = project.folder / "src" / "b.txt"
    file.write_text("1 2 3 4")
    with monkeypatch.context() as patch:
        after_stage_call(patch, lambda: damages.overwrite(file, b"5 6 7 8"))
        failed = project.lab.call(f"{CHAIN[0]} --replace")
    assert failed.code == FAILED and "src/b.txt changed while it was read" in failed.err, failed
    assert project.data_files() == dict(project.sound)
    project.lab.run(f"{CHAIN[0]} --replace")
    assert specimen.read_content(project.folder / "data/recordings")["b/left.parquet"][0][-1] == [5, 6, 7, 8]


def test_a_file_that_vanishes_while_it_is_ingested_is_a_sentence(
    project: Specimen, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = project.folder / "src" / "b.txt"
    file.write_text("1 2 3 4")
    with monkeypatch.context() as patch:
        after_stage_call(patch, file.unlink)
        failed = project.lab.call(f"{CHAIN[0]} --replace")
    assert failed.code == FAILED and "src/b.txt" in failed.err and "Traceback" not in failed.err, failed
    assert project.data_files() == dict(project.sound)


def test_objects_damaged_between_two_reads_are_never_served(project: Specimen, monkeypatch: pytest.MonkeyPatch) -> None:
    objects = [project.object("recordings", f"{name}/left.parquet") for name in "abc"]

    def damage() -> None:
        for path in objects:
            damages.flip(path)

    after_stage_call(monkeypatch, damage)
    project.lab.run("scale data/recordings -o data/other --factor 9 --jobs 1")
    contents = specimen.read_content(project.folder / "data/other")
    assert [contents[f"{name}.parquet"][0][-1][1] for name in "abc"] == [9, 54, 99]


def test_a_dataset_that_is_relinked_while_it_is_read_is_read_as_it_was_at_first(
    project: Specimen, monkeypatch: pytest.MonkeyPatch
) -> None:
    def relink() -> None:
        manifest = project.folder / "data/scaled/manifest.json"
        damages.overwrite(manifest, project.sound["named/manifest.json"])

    after_stage_call(monkeypatch, relink)
    project.lab.run("total data/scaled -o data/other")
    assert project.lab.manifest("data/other").digest == project.manifests["total"].digest
    assert project.lab.call("store verify").code == 0


def test_a_fit_of_which_nothing_is_stored_cannot_be_compared(uncertain: Specimen) -> None:
    compared = uncertain.lab.call("fitted data/scaled --split data/split -o data/u --recompute-and-compare")
    assert (
        compared.code == 2 and "There is no stored result of fitted.fit" in compared.err and not Path("data/u").exists()
    )
