"""Test that names of classes are unique, that the glossary is used, and that public functions document their errors."""

import ast
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from tests.test_docs import section

ROOT = Path(__file__).parents[1]


def library_modules() -> list[Path]:
    return [path for folder in ("tacpipe", "stages") for path in sorted((ROOT / folder).rglob("*.py"))]


def test_no_two_classes_of_the_library_have_the_same_name() -> None:
    counts = Counter(
        node.name
        for path in library_modules()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ClassDef)
    )
    assert {name for name, count in counts.items() if count > 1} == {"Params"}


def test_each_term_of_the_glossary_is_used() -> None:
    glossary = section((ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"), "Glossary")
    terms = [
        term.strip("` ")
        for line in glossary.splitlines()
        if line.startswith("| ") and not line.startswith(("| term", "| ---"))
        for term in line.split("|")[1].split(",")
    ]
    texts = " ".join(
        path.read_text(encoding="utf-8") for path in (*library_modules(), *sorted((ROOT / "docs").rglob("*.md")))
    )
    assert len(terms) > 30
    assert [term for term in terms if not re.search(rf"\b{re.escape(term)}s?\b", texts, re.IGNORECASE)] == []


def raising_functions(tree: ast.AST) -> Iterator[tuple[ast.FunctionDef, set[str]]]:
    """Yield the public functions and methods of a module with the names of the errors that they raise themselves."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from raising_functions(node)
        elif isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield node, set(raised_names(node))


def raised_names(function: ast.AST) -> Iterator[str]:
    """Yield the error of each raise statement of a function, without those of functions inside it."""
    for node in ast.iter_child_nodes(function):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and isinstance(node.exc.func, ast.Name):
            yield node.exc.func.id
        if not isinstance(node, ast.FunctionDef | ast.Lambda):
            yield from raised_names(node)


def test_public_functions_document_the_errors_that_they_raise() -> None:
    undocumented = [
        f"{path.relative_to(ROOT)}: {function.name}"
        for path in library_modules()
        if path.parts[-2] not in ("cli", "stages")  # their docstrings are help texts
        for function, errors in raising_functions(ast.parse(path.read_text(encoding="utf-8")))
        if errors & {"TacpipeError", "UsageError", "StorageError", "DamagedError", "MissingError"}
        if "aise" not in (ast.get_docstring(function) or "")
        if path.stem not in ("hdf5", "vision2tactile", "alarms")  # the docstrings of two stages are help texts
    ]
    assert undocumented == []
