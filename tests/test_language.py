"""The words of the project: help, errors and docs use the field's terms, and none of those that they replace.

CONTRIBUTING.md has the glossary. A true exception stands in `EXCEPTIONS`, with the reason.
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tests.conftest import Lab
from tests.test_docs import BUILT_IN, COMMANDS, PAGES, hooks

ROOT = Path(__file__).parents[1]
WORDS = re.compile(
    r"""\b(?:
        foretells? | foretold | foretelling | tells? | told | telling | says? | said | saying
      | judg(?:e|es|ed|ing) | mend(?:s|ed|ing)? | ma[dk]e\ again | made\ anew
      | wish(?:es|ed)? | heed(?:s|ed)? | believ(?:e|es|ed) | claim(?:s|ed)? | strangers?(?:'s)?
      | lost\ track | no\ longer\ at\ a\ path | st(?:ands?|ood)\ (?:for|beside)
      | felt | feels? | touch\ to\ come | held\ rows | rows\ that\ are\ held
      | bars?\ (?:is|are|was|were)?\ ?(?:reached|missed) | (?:reached|missed)\ (?:the|a)\ bar
      | looks?\ after | looking\ after | goe?s?\ on | went\ on | ends\ within
      | first\ weights | most\ passes | shares?\ of
    )\b
    | (?<!there\ )(?<!There\ )\b(?:is|are|was|were)\ no\b(?!\ (?:longer|more|less|better|later)\b)""",
    re.VERBOSE | re.IGNORECASE,
)
EXCEPTIONS: dict[str, str] = {}  # words in their context, and why they are right there
NAMES = re.compile(
    r"(?:^|_)(?:foretell|foretold|tells?|told|judg(?:e|ed|es|ing)|mend(?:ed|s)?|wish(?:es|ed)?|heeds?|heeded|"
    r"believed?|claim(?:s|ed)?|strangers?|felt)(?:_|$)|^_?(?:Told|Tell|Telling|Felt|Judged|Wishes|Mended)$"
)
PACKAGES = (  # whose names follow the table of words
    *("cli", "formats", "links", "maintenance", "recording", "report", "sensors", "signals", "simulation", "store"),
)

EXPLAINED = ("stages", *(f"tacpipe/{path.parent.name}" for path in sorted((ROOT / "tacpipe").glob("*/__init__.py"))))
BE_NO = re.compile(r"\w+ no", re.IGNORECASE)  # is checked where users read it


def found(text: str) -> list[str]:
    """Return each word that is not used, with what stands around it; code is left out."""
    plain = re.sub(r"`[^`\n]*`|^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)
    spots = [" ".join(plain[max(0, at.start() - 30) : at.end() + 20].split()) for at in WORDS.finditer(plain)]
    return [spot for spot in spots if not any(words in spot for words in EXCEPTIONS)]


def sources() -> list[Path]:
    return [path for folder in ("tacpipe", "stages") for path in sorted((ROOT / folder).rglob("*.py"))]


def sentences(tree: ast.AST) -> Iterator[str]:
    """Yield the string literals of every ``raise`` statement; values in them as ``{}``."""
    for raised in ast.walk(tree):
        if not isinstance(raised, ast.Raise):
            continue
        nodes = list(ast.walk(raised))
        inner = {id(part) for node in nodes if isinstance(node, ast.JoinedStr) for part in node.values}
        for node in nodes:
            if isinstance(node, ast.JoinedStr):
                yield "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in inner:
                yield node.value


def names(tree: ast.AST) -> Iterator[str]:
    """Yield the names of functions, classes, arguments and variables."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
            yield node.name
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("The model foretells touch.", 1),
        ("seed is 'x', which " + "is no number", 1),
        ("There is no rig file; it is no longer there.", 0),
        ("a share of the range, as told", 2),
        ("The shared store predicts.", 0),
        ("`tells` is code", 0),
    ],
)
def test_the_words_that_are_not_used_are_found_and_others_are_not(text: str, words: int) -> None:
    assert len(found(text)) == words


@pytest.mark.parametrize("command", COMMANDS)
def test_no_help_has_a_word_that_is_not_used(command: str) -> None:
    assert found(hooks().help_of(command.split())) == []


def test_no_error_has_a_word_that_is_not_used() -> None:
    wrong = {
        f"{path.relative_to(ROOT)}: {spot}"
        for path in sources()
        for text in sentences(ast.parse(path.read_text(encoding="utf-8")))
        for spot in found(text)
    }
    assert sorted(wrong) == []


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CONTRIBUTING.md"], ids=lambda page: page.relative_to(ROOT).as_posix())
def test_no_page_has_a_word_that_is_not_used(page: Path) -> None:
    assert found(page.read_text(encoding="utf-8")) == []


def test_no_generated_page_has_a_word_that_is_not_used() -> None:
    assert {path: spots for path, text in hooks().pages().items() if (spots := found(text))} == {}


@pytest.mark.parametrize("package", PACKAGES)
def test_no_function_class_or_variable_has_a_name_that_is_not_used(package: str) -> None:
    wrong = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in sorted((ROOT / "tacpipe" / package).rglob("*.py"))
        for name in (path.stem, *names(ast.parse(path.read_text(encoding="utf-8"))))
        if NAMES.search(name)
    }
    assert sorted(wrong) == []


@pytest.mark.parametrize("name", BUILT_IN)
def test_no_param_has_a_name_that_is_not_used(name: str) -> None:
    params = params_of.fields(registry.load(name))
    assert [
        param for param in params if NAMES.search(param) or set(param.split("_")) & {"share", "shares", "ratio"}
    ] == []


def test_no_test_module_or_helper_has_a_name_that_is_not_used() -> None:
    wrong = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in sorted((ROOT / "tests").rglob("*.py"))
        for name in (path.stem, *helpers(ast.parse(path.read_text(encoding="utf-8"))))
        if NAMES.search(name) and "report" not in path.parts
    }
    assert sorted(wrong) == []


def helpers(tree: ast.AST) -> Iterator[str]:
    """Yield the names of functions that are not tests, whose names are sentences, and of classes."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("test_"):
            yield node.name


@pytest.mark.parametrize("package", EXPLAINED)  # every docstring and comment of the library follows the table too
def test_no_docstring_or_comment_has_a_word_that_is_not_used(package: str) -> None:
    wrong = {
        f"{path.relative_to(ROOT)}: {word[0]}"
        for path in sorted((ROOT / package).rglob("*.py"))
        for text in explanations(path.read_text(encoding="utf-8"))
        for word in WORDS.finditer(re.sub(r"`[^`\n]*`|^ *>>>.*\n.*$", "", text, flags=re.MULTILINE))
        if not BE_NO.fullmatch(word[0])
        and word[0] not in ("ends within", "say")  # "say" for example; a file ends within
    }
    assert sorted(wrong) == []


def explanations(source: str) -> Iterator[str]:
    """Yield the docstrings and the comments of a module."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield ast.get_docstring(node) or ""
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    yield from (token.string for token in tokens if token.type == tokenize.COMMENT)


def test_help_of_a_command_that_a_test_runs_is_the_page_s(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "102")
    assert lab.run("show --help").out.strip() == hooks().help_of(["show"])
