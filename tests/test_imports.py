"""Starting the command line imports no library that a rerun does not use."""

import ast
import functools
import json
import re
import tomllib
from collections.abc import Iterator, Mapping
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import tacpipe
from tests import chain, commands
from tests.conftest import run_python

HEAVY = {"torch", "pyarrow", "pandas", "sklearn", "open3d", "numpy", "scipy", "matplotlib"}
COMPILERS = {"torch._dynamo", "torch._inductor", "torch.onnx", "sympy"}  # each takes as long as a small evaluation
PROBE = """
import json, sys
from tacpipe.cli import main as cli
sys.argv = ["tacpipe", *sys.argv[1:]]
try:
    cli.main()
except SystemExit as stop:
    assert not stop.code, stop.code
print(json.dumps(sorted(sys.modules)))
"""


def imported_modules(folder: Path, words: str) -> set[str]:
    """Return the full names of all modules that a command imports."""
    process = run_python(folder, "-c", PROBE, *words.split(), check=True)
    return set(json.loads(process.stdout.splitlines()[-1]))


def imported(folder: Path, words: str) -> set[str]:
    """Return the packages that a command imports."""
    return {name.partition(".")[0] for name in imported_modules(folder, words)}


@pytest.fixture(scope="module")
def lab(chained: Path) -> Path:
    return chained


@pytest.mark.parametrize(
    "words", ["--help", "train --help", "train forward --help", "store gc --help", "show --help", "candidates --help"]
)
def test_help_imports_nothing_heavy(tmp_path: Path, words: str) -> None:
    assert imported(tmp_path, words) & HEAVY == set()


def test_help_of_live_sessions_imports_no_torch_which_the_computer_of_a_rig_may_lack(tmp_path: Path) -> None:
    assert "torch" not in imported(tmp_path, "live --help")


def test_help_of_a_stage_imports_none_of_what_runs_stages(tmp_path: Path) -> None:
    running = {f"tacpipe.engine.{name}" for name in ("pipeline", "by_recording", "grid")}
    assert imported_modules(tmp_path, "synchronize --help") & running == set()


@pytest.mark.parametrize("words", chain.CHAIN, ids=lambda words: words.split()[0])
def test_a_hit_imports_nothing_heavy(lab: Path, words: str) -> None:
    assert imported(lab, words) & HEAVY == set()


def test_showing_explaining_and_looking_after_the_store_import_nothing_heavy(lab: Path) -> None:
    show_commands = ("show models/forward --json", "show results/forward --json")
    for words in (*show_commands, "explain report.html", "store status", "store verify", "store gc --dry-run"):
        assert imported(lab, words) & HEAVY == set()


def test_ingest_does_not_import_torch(tmp_path: Path, lab: Path) -> None:
    assert "torch" not in imported(lab, "synchronize data/recordings -o data/other --rate-hz 20 --jobs 1")


@pytest.mark.parametrize("words", ["synchronize data/recordings", "segment contacts data/synced"])
def test_synchronizing_and_segmenting_import_no_pandas(lab: Path, words: str) -> None:
    changed = "--rate-hz 21" if words.startswith("sync") else "--min-s 0.031"
    assert "pandas" not in imported(lab, f"{words} -o data/without-pandas-{words[:3]} {changed} --jobs 1")


@pytest.mark.parametrize("task", ["forward", "material", "touch"])
def test_the_report_of_a_task_imports_no_torch(task: str) -> None:
    lines = (
        "import importlib, pkgutil, sys",
        f"import tacpipe.tasks.{task}.report as report",
        "for module in pkgutil.iter_modules(report.__path__, report.__name__ + '.'):",
        "    importlib.import_module(module.name)",
        "print('torch' in sys.modules)",
    )
    process = run_python(Path(), "-c", "\n".join(lines), check=True)
    assert process.stdout == "False\n"


def test_using_the_default_forecaster_imports_only_what_models_need(lab: Path) -> None:
    commands.run(
        lab, ["train forward data/segments --split data/split --epochs 1 --hidden 8 --stride 4 -o models/default"]
    )
    for words in (
        "evaluate models/default data/segments --split data/split -o results/default",
        "predict models/default data/segments --split data/split --role test -o data/predicted",
    ):
        modules = imported_modules(lab, f"{words} --jobs 1")
        assert modules & COMPILERS == set()
        assert {name.partition(".")[0] for name in modules} & HEAVY <= {"numpy", "pandas", "pyarrow", "torch"}


ROOT = Path(tacpipe.__file__).parent
PARTS_OF_AN_IDENTITY = {"stage", "version", "params", "inputs"}


def modules(*folders: str) -> Iterator[tuple[str, ast.Module]]:
    for folder in folders or ("",):
        for file in sorted((ROOT / folder).rglob("*.py")):
            yield str(file.relative_to(ROOT)), ast.parse(file.read_text())


def calls(tree: ast.AST, module: str) -> list[str]:
    """Return the functions of an imported module that are called."""
    return [
        node.func.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and isinstance(node.func.value, ast.Name)
        and node.func.value.id == module
    ]


def test_a_run_settles_its_output_in_one_call() -> None:
    (tree,) = (tree for name, tree in modules("engine") if name == "engine/pipeline.py")
    assert calls(tree, "output") == ["settle"]
    assert calls(tree, "directory") == []


def test_identities_are_built_in_one_place() -> None:
    modules_with_identities = {
        name
        for name, tree in modules()
        for node in ast.walk(tree)
        if isinstance(node, ast.Dict)
        and {key.value for key in node.keys if isinstance(key, ast.Constant)} == PARTS_OF_AN_IDENTITY
    }
    assert modules_with_identities == {"engine/keys.py"}


def test_datasets_and_the_store_know_nothing_of_the_engine_not_even_its_types() -> None:
    for name, tree in modules("datasets", "store", "plugins", "channels"):
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom):
                assert not (node.module or "").startswith(("tacpipe.engine", "tacpipe.cli")), name


def test_what_a_directory_shows_changes_in_one_function_alone() -> None:
    changing = {
        name for name, tree in modules() if "changing" in calls(tree, "directory") + calls(tree, "directory_of")
    }
    assert changing == {"engine/output.py", "maintenance/repair.py"}  # a file of a result; links that are made good


# Imports of types that close a circle of files. The params of an architecture create what its training and its stored
# files become, and these take the params; a part of a reader of files states the reading that it is a part of.
CLOSING = {
    "tacpipe.formats.table.column_names": {"tacpipe.formats.arrays.tree"},
    "tacpipe.formats.xdf_restarts": {"tacpipe.formats.xdf_streams"},
    "tacpipe.formats.xdf_times": {"tacpipe.formats.xdf_streams"},
    "tacpipe.tasks.material.params": {"classifier", "network_training"},
    "tacpipe.tasks.touch.params": {"members", "predictor", "training"},
}


@functools.cache
def import_graph() -> Mapping[str, frozenset[str]]:
    """Return the modules that each module of tacpipe imports, in functions and for types too."""
    trees = {
        ".".join(["tacpipe", *Path(path).with_suffix("").parts]).removesuffix(".__init__"): tree
        for path, tree in modules()
    }
    graph = {}
    for module, tree in trees.items():
        names = []
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                names += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                members = [f"{node.module}.{alias.name}" for alias in node.names]
                names += [member if member in trees else str(node.module) for member in members]
        graph[module] = frozenset(names) & trees.keys() - {module}
    return graph


def test_no_files_import_each_other_in_a_circle_not_even_types() -> None:
    graph = dict(import_graph())
    for module, closing in CLOSING.items():
        full_names = {name if "." in name else f"{module.rpartition('.')[0]}.{name}" for name in closing}
        assert full_names <= graph[module], "take what closes no circle any more out of CLOSING"
        graph[module] -= full_names
    TopologicalSorter(graph).prepare()  # raises CycleError, which names the files of a circle


def test_no_type_is_imported_from_a_higher_layer() -> None:
    contracts = tomllib.loads((ROOT.parent / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layers = [re.split(r" [|:] ", layer) for layer in contracts[0]["layers"]]
    height = {package: -number for number, packages in enumerate(layers) for package in packages}
    edges = [(module.split(".")[1:], name.split(".")[1:]) for module, names in import_graph().items() for name in names]
    upward = {
        (".".join(module), ".".join(name))
        for module, name in edges
        if module and name and module[0] in height and height[name[0]] > height[module[0]]
    }
    assert upward == set()
