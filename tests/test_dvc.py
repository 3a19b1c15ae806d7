"""Chains under real DVC: it tracks manifests alone, and tacpipe reads what these name."""

import itertools
import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
import yaml

import tacpipe
from tacpipe.plugins import registry
from tests.conftest import Lab, make_once

HERE = Path(__file__).parents[1]
NEEDS_DVC = pytest.mark.skipif(
    shutil.which("git") is None or not Path(sys.executable).with_name("dvc").exists(),
    reason="git and DVC (the extra dev) are needed",
)
PARAMS = "toy:\n  offset: 1\n  scale:\n    factor: 2\n"
CHAIN = """
stages:
  recordings:
    cmd: tacpipe simulate toy --offset ${toy.offset} -o data/recordings
    params: [toy.offset]
    outs: [{data/recordings/manifest.json: {persist: true}}]
  scaled:
    cmd: tacpipe scale data/recordings -o data/scaled --block toy.scale
    deps: [data/recordings/manifest.json]
    params: [toy.scale]
    outs: [data/scaled/manifest.json]
  total:
    cmd: tacpipe total data/scaled -o results/toy
    deps: [data/scaled/manifest.json]
    outs: [results/toy/manifest.json]
    metrics: [{results/toy/metrics.json: {cache: false}}]
"""


@dataclass
class Project:
    """A git and DVC repository."""

    folder: Path
    environment: Mapping[str, str]

    def run(self, command: str) -> str:
        """Return what a command that must succeed printed."""
        process = subprocess.run(
            shlex.split(command), cwd=self.folder, env=self.environment, capture_output=True, text=True, check=False
        )
        assert process.returncode == 0, f"{command} ended with {process.returncode}: {process.stdout}{process.stderr}"
        return process.stdout + process.stderr

    def start(self, params: Mapping[str, Any] | None = None) -> None:
        """Make the folder a repository and commit what is in it, with ``params`` in the params file."""
        if params is not None:
            (self.folder / "params.yaml").write_text(yaml.safe_dump(params, sort_keys=False))
        self.run("git init --quiet")
        self.run("dvc init --quiet")
        self.commit("start")

    def commit(self, message: str) -> None:
        """Commit everything that is not ignored."""
        self.run("git add --all")
        self.run(f"git commit --quiet --message {shlex.quote(message)}")

    def change(self, old: str, new: str) -> None:
        """Replace a text in the params file."""
        text = (self.folder / "params.yaml").read_text()
        assert old in text
        (self.folder / "params.yaml").write_text(text.replace(old, new))

    def values(self, dataset: str) -> dict[str, list[int]]:
        """Return the values of each recording as tacpipe reads them."""
        shards = tacpipe.open(self.folder / dataset).recordings
        return {name: shard.table()["x"].to_pylist() for name, shard in shards.items()}

    def values_in_folder(self, dataset: str) -> dict[str, list[int]]:
        """Return the values in the Parquet files of the manifest's folder, whether or not the manifest names them."""
        return {path.stem: pq.read_table(path)["x"].to_pylist() for path in (self.folder / dataset).glob("*.parquet")}


@pytest.fixture
def environment(tmp_path: Path, plugin: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """An environment in which neither git nor DVC knows who runs them."""
    monkeypatch.delenv("TACPIPE_STORE", raising=False)
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(("GIT_", "DVC_", "TACPIPE_"))}
    return {
        **inherited,
        "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
        "PYTHONPATH": str(plugin),
        "HOME": str(tmp_path),
        "GIT_CONFIG_GLOBAL": os.devnull,
        "GIT_AUTHOR_NAME": "lab",
        "GIT_AUTHOR_EMAIL": "lab@example.org",
        "GIT_COMMITTER_NAME": "lab",
        "GIT_COMMITTER_EMAIL": "lab@example.org",
        "OMP_NUM_THREADS": "1",
        "DVC_NO_ANALYTICS": "1",
        "DVC_GLOBAL_CONFIG_DIR": str(tmp_path / "dvc-global"),
        "DVC_SYSTEM_CONFIG_DIR": str(tmp_path / "dvc-system"),
        "DVC_SITE_CACHE_DIR": str(tmp_path / "dvc-site"),
    }


@pytest.fixture
def toy(tmp_path: Path, environment: Mapping[str, str], tmp_path_factory: pytest.TempPathFactory) -> Project:
    """A repository whose chain was run with a factor of 2, then of 3, each committed; copied from one that did."""

    def make(folder: Path) -> None:
        project = Project(folder, environment)
        (folder / "dvc.yaml").write_text(CHAIN)
        (folder / "params.yaml").write_text(PARAMS)
        (folder / ".gitignore").write_text(".tacpipe/\n*.parquet\n")
        project.start()
        project.run("dvc repro")
        project.commit("factor 2")
        project.change("factor: 2", "factor: 3")
        project.run("dvc repro")
        project.commit("factor 3")

    prototype = make_once(tmp_path_factory, "dvc", make)
    return Project(shutil.copytree(prototype, tmp_path / "toy", symlinks=True), environment)


def copy_chains(folder: Path, environment: Mapping[str, str]) -> tuple[Project, dict[str, Any]]:
    """Return a project with the chains of this repository, and their params."""
    for name in ("dvc.yaml", "params.yaml", "docs/tasks/horizons.json"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(HERE / name, folder / name)
    (folder / ".gitignore").write_text(".tacpipe/\n/data/\n/models/\n/results/\n")
    return Project(folder, environment), yaml.safe_load((folder / "params.yaml").read_text())


def expected_values(factor: int) -> dict[str, list[int]]:
    """Return the values that the toy chain computes with an offset of 1."""
    return {f"trial-{trial:03d}": [factor * (row * (trial + 1) + 1) for row in range(20)] for trial in range(4)}


def cached_contents(folder: Path) -> list[bytes]:
    """Return the content of every file in DVC's cache."""
    return [path.read_bytes() for path in (folder / ".dvc" / "cache").rglob("*") if path.is_file()]


@pytest.mark.long
@pytest.mark.dvc
@NEEDS_DVC
def test_a_method_of_the_forward_chain_runs_once_and_dvc_shows_its_metrics_params_and_plots(
    tmp_path: Path, environment: Mapping[str, str]
) -> None:
    project, params = copy_chains(tmp_path / "forward", environment)
    params["forward"] |= {"recordings": "simulate forward --trials 10 --duration-s 4", "preset": "quick", "folds": [0]}
    params["forward"]["quick"]["methods"]["taxelwise"] |= {"epochs": 1, "hidden": 8}
    project.start(params)
    target, results = "forward-calibrated@taxelwise-0", "results/forward/taxelwise/0"
    project.run(f"dvc repro {target}")
    second_run = project.run(f"dvc repro {target}")
    project.commit("one epoch")

    assert "Running stage" not in second_run
    assert "up to date" in second_run
    printed = json.loads(project.run(f"dvc metrics show --json {results}/metrics.json"))
    metrics = printed[""]["data"][f"{results}/metrics.json"]["data"]
    assert metrics["model"]["mae_counts"]["both"]["t10"] > 0
    assert metrics["persistence"]["mae_counts"]["both"]["t10"] > 0
    calibrated = json.loads((project.folder / "results/forward/taxelwise-calibrated/0/metrics.json").read_text())
    assert calibrated["quantiles"]["levels"] == [10, 50, 90] and calibrated["model"] == metrics["model"]
    project.change("rest_s: 0.2", "rest_s: 0.3")
    changed = json.loads(project.run("dvc params diff --json"))["params.yaml"]
    assert changed == {"forward.segment.rest_s": {"old": 0.2, "new": 0.3, "diff": pytest.approx(0.1)}}
    project.run("dvc plots show --out plots")
    page = (project.folder / "plots" / "index.html").read_text()
    assert "persistence" in page
    assert "mse_counts" in page
    assert "<DVC_METRIC" not in page
    contents = cached_contents(project.folder)
    # a manifest each of recordings, synced, segments and split, and of model and results before and after calibration
    assert sum(b'"format": 1' in content for content in contents) == 8
    assert not [content for content in contents if content.startswith(b"PAR1")]
    assert max(map(len, contents)) < 5_000_000


@pytest.mark.long
@pytest.mark.dvc
@NEEDS_DVC
def test_a_method_of_the_material_chain_runs_once_and_is_reported(
    tmp_path: Path, environment: Mapping[str, str]
) -> None:
    project, params = copy_chains(tmp_path / "material", environment)
    params["material"]["sources"] = {"simulated": "simulate material --trials 96 --materials 3 --no-pac"}
    params["material"]["readouts"]["patterns"]["features"] = 200
    params["material"]["calibrate"] = {"false_unknown": 0.4}  # So few slides cannot promise a lower rate.
    project.start(params)
    project.run("dvc repro material-readout@patterns-0")
    second_run = project.run("dvc repro material-readout@patterns-0")

    assert "Running stage" not in second_run
    metrics = json.loads((project.folder / "results/material/patterns/0/metrics.json").read_text())
    assert metrics["model"]["n"] == {"biotac": 12, "roboskin": 12}
    assert metrics["model"]["accuracy"]["biotac"] > metrics["chance"]["accuracy"]["biotac"]
    project.run("tacpipe report results/material/patterns/0 data/material/slides -o results/material.html")
    assert "simulated" in (project.folder / "results/material.html").read_text()
    project.run("dvc repro material-calibrated@0")
    calibrated = json.loads((project.folder / "results/material/calibrated/0/metrics.json").read_text())
    assert set(calibrated["unknown"]) == {"biotac", "roboskin"}


@pytest.mark.long
@pytest.mark.dvc
@NEEDS_DVC
def test_methods_and_settings_of_the_touch_chain_run_once_and_are_reported(
    tmp_path: Path, environment: Mapping[str, str]
) -> None:
    project, params = copy_chains(tmp_path / "touch", environment)
    small = {"folds": [0], "objects": [0], "methods": ["trees", "pointnet"], "settings": ["xyz"]}
    params["touch"] |= {"recordings": "simulate touch --trials 24 --objects 1 --families box,sphere", **small}
    methods, settings = params["touch"]["quick"]["methods"], params["touch"]["quick"]["settings"]
    methods["trees"]["trees"] = 5
    for options in (methods["pointnet"], settings["xyz"]):
        options |= {"epochs": 1, "points": 32, "head": "fc1"}
    project.start(params)
    project.run("dvc repro touch")
    second_run = project.run("dvc repro touch")

    assert "Running stage" not in second_run
    result_folders = sorted(
        str(path.relative_to(project.folder / "results")) for path in project.folder.glob("results/touch/*/*")
    )
    methods_and_splits = [
        f"touch/{method}-{split}/0" for method in ("pointnet", "trees") for split in ("known", "later", "novel")
    ]
    assert result_folders == ["touch/calibrated/0", *methods_and_splits, "touch/xyz/0"]
    quantiles = json.loads((project.folder / "results/touch/calibrated/0/metrics.json").read_text())["quantiles"]
    assert quantiles["levels"] == [10, 50, 90] and 0 <= quantiles["known"]["model"]["coverage"]["e_th"] <= 1
    metrics = {
        name: json.loads((project.folder / f"results/{name}/metrics.json").read_text()) for name in methods_and_splits
    }
    assert metrics["touch/trees-known/0"]["known"]["counts"]["grasps"] in (
        4,
        5,
        6,
    )  # A fold of 5 tests 2 objects of the 24 grasps.
    assert metrics["touch/trees-novel/0"]["novel"]["counts"] == {"grasps": 12, "objects": 1}
    assert metrics["touch/trees-later/0"]["known"]["counts"] == {"grasps": 6, "objects": 2}
    lines = project.run(
        "dvc metrics show " + " ".join(f"results/{name}/summary.json" for name in methods_and_splits)
    ).splitlines()
    assert lines[0].split()[:5] == ["Path", "e_mf", "e_th", "gain", "high"] and max(map(len, lines)) <= 120
    page = (project.folder / "results/touch.html").read_text()
    for text in (
        "5 folds",
        "5 folds, calibrated",
        "Coverage of the 10 to 90 % band",
        "leave one object out",
        "later grasps",
        "inputs: ",
    ):
        assert text in page


@pytest.mark.long
@pytest.mark.dvc
@NEEDS_DVC
def test_after_checkout_of_an_older_commit_tacpipe_reads_what_the_manifest_names(toy: Project) -> None:
    assert toy.values("data/scaled") == expected_values(3)
    toy.run("git checkout --quiet HEAD~1")
    toy.run("dvc checkout")

    assert toy.values_in_folder("data/scaled") == expected_values(3)  # stale: DVC knows nothing of them
    assert toy.values("data/scaled") == expected_values(2)
    toy.run("tacpipe store link data/scaled")
    assert toy.values_in_folder("data/scaled") == expected_values(2)
    assert "Running stage" not in toy.run("dvc repro")


@pytest.mark.long
@pytest.mark.dvc
@NEEDS_DVC
def test_after_a_restore_from_the_run_cache_tacpipe_reads_what_the_manifest_names(toy: Project) -> None:
    toy.change("factor: 3", "factor: 2")
    output = toy.run("dvc repro")

    assert "Stage 'scaled' is cached" in output
    assert toy.values_in_folder("data/scaled") == expected_values(3)  # stale: the stage did not run
    assert toy.values("data/scaled") == expected_values(2)
    metrics = json.loads((toy.folder / "results" / "toy" / "metrics.json").read_text())
    assert metrics == {name: sum(values) for name, values in expected_values(2).items()}


@pytest.mark.long
@pytest.mark.dvc
@NEEDS_DVC
def test_a_second_clone_with_the_same_caches_gets_the_results_without_running_a_stage(
    toy: Project, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    toy.run(f"git clone --quiet . {tmp_path / 'clone'}")
    store = str(toy.folder / ".tacpipe")
    clone = Project(tmp_path / "clone", {**toy.environment, "TACPIPE_STORE": store})
    monkeypatch.setenv("TACPIPE_STORE", store)
    clone.run(f"dvc cache dir --local {toy.folder / '.dvc' / 'cache'}")
    first = clone.run("dvc repro")
    assert "0 ran, 4 reused" in first  # recordings have no input that DVC could look up, so they are asked for
    assert "Stage 'scaled' is cached" in first
    assert clone.values("data/scaled") == expected_values(3)

    for folder in ("data/scaled", "results"):
        shutil.rmtree(clone.folder / folder)
    clone.change("factor: 3", "factor: 2")
    assert "Stage 'scaled' is cached" in clone.run("dvc repro")
    assert clone.values("data/scaled") == expected_values(2)


@pytest.mark.long
@pytest.mark.dvc
@NEEDS_DVC
def test_labels_set_by_hand_survive_the_next_repro(toy: Project) -> None:
    toy.run("tacpipe label data/recordings trial-002 --label material=foam")
    output = toy.run("dvc repro")

    assert "Running stage 'scaled'" in output
    assert "0 ran, 4 reused" in output  # no shard reads the label
    assert tacpipe.open(toy.folder / "data/scaled").recordings["trial-002"].attributes["material"] == "foam"
    assert "Running stage" not in toy.run("dvc repro")


def fill_names(value: Any, names: Mapping[str, str]) -> Any:
    """Return ``value`` with each ``${name}`` in its texts replaced."""
    if isinstance(value, str):
        for name, text in names.items():
            value = value.replace(f"${{{name}}}", text)
        return value
    if isinstance(value, list):
        return [fill_names(item, names) for item in value]
    if isinstance(value, dict):
        return {fill_names(name, names): fill_names(item, names) for name, item in value.items()}
    return value


def look_up(value: Any, params: Mapping[str, Any]) -> Any:
    """Return a list of the chain, which may be told by the name of a param like ``${forward.folds}``."""
    if isinstance(value, str) and value.startswith("${"):
        for part in value[2:-1].split("."):
            params = params[part]
        return params
    return value


def items_of(value: Mapping[str, Any], params: Mapping[str, Any]) -> Iterator[dict[str, str]]:
    """Yield what stands for ``${item...}`` and ``${key}`` in each stage that a ``matrix`` or ``foreach`` makes."""
    if "foreach" in value:
        for key, choice in look_up(value["foreach"], params).items():
            yield {"key": key, "item": choice}
        return
    matrix = {key: look_up(values, params) for key, values in value.get("matrix", {}).items()}
    matrix = {key: values[:1] if key == "fold" else values for key, values in matrix.items()}
    for chosen in itertools.product(*matrix.values()):
        replacements: dict[str, str] = {}
        for key, choice in zip(matrix, chosen, strict=True):
            parts = (
                {f"item.{key}.{part}": str(text) for part, text in choice.items()} if isinstance(choice, dict) else {}
            )
            replacements |= parts or {f"item.{key}": str(choice)}
        yield replacements


def stages(preset: str) -> Iterator[tuple[str, dict[str, Any], list[list[str]]]]:
    """Yield each stage of the project's own chains in its first fold, and the words of each of its commands."""
    params = yaml.safe_load((HERE / "params.yaml").read_text())
    replacements = {
        f"{task}.{name}": text
        for task, task_params in params.items()
        for name, text in task_params.items()
        if isinstance(text, str)
    }
    replacements |= {f"{task}.preset": preset for task in params}
    for name, value in yaml.safe_load((HERE / "dvc.yaml").read_text())["stages"].items():
        for items in items_of(value, params):
            body = value.get("do", value)
            filled_stage = fill_names(
                {key: part for key, part in body.items() if key != "matrix"}, {**replacements, **items}
            )
            commands = filled_stage["cmd"] if isinstance(filled_stage["cmd"], list) else [filled_stage["cmd"]]
            yield "-".join([name, *items.values()]), filled_stage, [shlex.split(command) for command in commands]


def output_of(words: list[str]) -> str:
    """Return what DVC tracks of a command's output."""
    output = words[words.index("-o") + 1]
    return output if output.endswith(".html") else f"{output}/manifest.json"


@pytest.mark.parametrize("preset", ["quick", pytest.param("paper", marks=pytest.mark.long)])
def test_every_command_of_the_chain_is_a_stage_whose_block_of_params_fits(preset: str, lab: Lab) -> None:
    stage_names, printed_blocks = registry.stages(), set()
    shutil.copy(HERE / "params.yaml", lab.folder)
    for name, value, commands in stages(preset):
        for words in commands:
            assert words[0] == "tacpipe", name
            assert words[1] in stage_names or f"{words[1]}.{words[2]}" in stage_names, name
            block = words[words.index("--block") + 1] if "--block" in words else ""
            assert not block or any(block.startswith(param) for param in value["params"]), name
            if (*words[1:3], block) not in printed_blocks:
                printed = json.loads(lab.run(shlex.join([*words[1:], "--print-params"])).out)
                assert isinstance(printed, dict), name
            printed_blocks.add((*words[1:3], block))


def test_dvc_tracks_manifests_and_the_report_alone() -> None:
    before: set[str] = set()
    for name, value, commands in stages("quick"):
        outs = {out if isinstance(out, str) else next(iter(out)) for out in value["outs"]}
        assert outs <= {output_of(words) for words in commands}, name
        assert output_of(commands[-1]) in outs, name
        for needed in value.get("deps", ()):
            assert needed in before or any(out.startswith(f"{needed}/") for out in before), name
        before |= outs
