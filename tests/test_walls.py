"""Walls between parts of the engine that no import contract sees."""

import ast
from collections.abc import Iterator
from pathlib import Path

import tacpipe

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
    assert calls(tree, "output") == ["existing_answer", "settle"]  # the first changes nothing
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
