"""Check the words of the project: help, errors and docs use the field's terms, and names and comments are plain.

CONTRIBUTING.md has the glossary. `EXCEPTIONS` has the true exceptions, each with its reason.
"""

import ast
import io
import re
import tokenize
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tests.conftest import Lab
from tests.test_docs import BUILT_IN, COMMANDS, PAGES, hooks, section

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
EXCEPTIONS: dict[str, str] = {}  # words in their context, and why they are right
NAMES = re.compile(
    r"(?:^|_)(?:foretell|foretold|tells?|told|judg(?:e|ed|es|ing)|mend(?:ed|s)?|wish(?:es|ed)?|heeds?|heeded|"
    r"believed?|claim(?:s|ed)?|strangers?|felt)(?:_|$)|^_?(?:Told|Tell|Telling|Felt|Judged|Wishes|Mended)$"
)
PACKAGES = (  # their names follow the table of words
    *("cli", "formats", "links", "maintenance", "recording", "report", "sensors", "signals", "simulation", "store"),
)

EXPLAINED = ("stages", *(f"tacpipe/{path.parent.name}" for path in sorted((ROOT / "tacpipe").glob("*/__init__.py"))))
BE_NO = re.compile(r"\w+ no", re.IGNORECASE)  # checked only in text for users


def find_unused_words(text: str) -> list[str]:
    """Return each word that is not used, with its context; code is left out."""
    prose = " ".join(re.sub(r"`[^`\n]*`|^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE).split())
    spots = [prose[max(0, match.start() - 30) : match.end() + 20].strip() for match in WORDS.finditer(prose)]
    return [spot for spot in spots if not any(words in spot for words in EXCEPTIONS)]


def library_modules() -> list[Path]:
    return [path for folder in ("tacpipe", "stages") for path in sorted((ROOT / folder).rglob("*.py"))]


def error_messages(tree: ast.AST) -> Iterator[str]:
    """Yield the string literals of every ``raise`` statement, each value in them as ``{}``."""
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


def bound_names(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line and name of functions, classes, arguments, and variables and attributes that are assigned."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
            yield node.lineno, node.name
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.attr


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
def test_words_that_are_not_used_are_reported_and_others_are_not(text: str, words: int) -> None:
    assert len(find_unused_words(text)) == words


@pytest.mark.parametrize("command", COMMANDS)
def test_no_help_has_a_word_that_is_not_used(command: str) -> None:
    assert find_unused_words(hooks().help_of(command.split())) == []


def test_no_error_has_a_word_that_is_not_used() -> None:
    wrong = {
        f"{path.relative_to(ROOT)}: {spot}"
        for path in library_modules()
        for text in error_messages(ast.parse(path.read_text(encoding="utf-8")))
        for spot in find_unused_words(text)
    }
    assert sorted(wrong) == []


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CONTRIBUTING.md"], ids=lambda page: page.relative_to(ROOT).as_posix())
def test_no_page_has_a_word_that_is_not_used(page: Path) -> None:
    assert find_unused_words(page.read_text(encoding="utf-8")) == []


def test_no_generated_page_has_a_word_that_is_not_used() -> None:
    assert {path: spots for path, text in hooks().pages().items() if (spots := find_unused_words(text))} == {}


@pytest.mark.parametrize("package", PACKAGES)
def test_no_function_class_or_variable_has_a_name_that_is_not_used(package: str) -> None:
    wrong = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in sorted((ROOT / "tacpipe" / package).rglob("*.py"))
        for _, name in ((0, path.stem), *bound_names(ast.parse(path.read_text(encoding="utf-8"))))
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
        for name in (path.stem, *helper_names(ast.parse(path.read_text(encoding="utf-8"))))
        if NAMES.search(name) and "report" not in path.parts
    }
    assert sorted(wrong) == []


def helper_names(tree: ast.AST) -> Iterator[str]:
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


PRONOUNS = """
    it they them this these that those its who whom whose which what why how where when here there then so such thus
    one ones other others another each every some both few many much more most less least several whole rest own owns
    something anything everything nothing somebody anybody everybody nobody thing things stuff alone
"""
PREPOSITIONS = """
    of for among within behind beside besides meanwhile aside apart together still again anew once twice
"""
PARTICIPLES = """
    found made taken kept given told said asked named wanted known seen shown left gone done came come stood looked held
    got gotten put gave brought thought believed meant stated stands stood began begun ended written had
"""
VAGUE_NAMES = frozenset(f"{PRONOUNS} {PREPOSITIONS} {PARTICIPLES}".split())  # names that fit anything
FRAGMENT = re.compile(  # first words of a comment that depends on what is next to it
    r"(?:of|in|on|at|by|to|from|for|with|without|within|behind|beside|next to|among|between|after|before"
    r"|which|that|whose|who|what|where|whether|as|than|so|nor|and|or|but|then)\b",
    re.IGNORECASE,
)
NO_PROSE = re.compile(r"noqa|type:|pragma|ruff:|fmt:|mypy:|[^A-Za-z]")  # starts of comments for tools
LIBRARY_LIMITS, TEST_LIMITS = (1.0, 6.0), (2.0, 8.0)  # largest shares of vague names and of fragments, in percent


def python_folders() -> dict[str, list[Path]]:
    """Return the modules of each package of the library and of each folder of tests, benchmarks and fuzzing."""
    folders: dict[str, list[Path]] = {}
    for root in ("tacpipe", "stages", "tests", "benchmarks", "fuzz"):
        for path in sorted((ROOT / root).rglob("*.py")):
            parts = path.relative_to(ROOT).parts
            folders.setdefault("/".join(parts[:2]) if len(parts) > 2 else parts[0], []).append(path)
    return folders


def comment_starts(source: str) -> Iterator[tuple[int, str]]:
    """Yield line and text of every comment in prose, and line and first line of every docstring."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        text = token.string.lstrip("#").strip()
        if token.type == tokenize.COMMENT and text and not NO_PROSE.match(text):
            yield token.start[0], text
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and (
            docstring := ast.get_docstring(node)
        ):
            yield node.body[0].lineno, docstring.splitlines()[0]


def plainness(paths: Iterable[Path]) -> tuple[list[str], float, list[str], float]:
    """Return vague names and fragments of modules, each with its place, followed by their shares in percent."""
    names, fragments, name_count, comment_count = [], [], 0, 0
    for path in paths:
        source, place = path.read_text(encoding="utf-8"), path.relative_to(ROOT)
        for line, name in bound_names(ast.parse(source)):
            name_count += 1
            names += [f"{place}:{line} {name}"] if name.strip("_") in VAGUE_NAMES else []
        for line, text in comment_starts(source):
            comment_count += 1
            fragments += [f"{place}:{line} {text:.60}"] if FRAGMENT.match(text) else []
    return names, 100 * len(names) / max(1, name_count), fragments, 100 * len(fragments) / max(1, comment_count)


@pytest.mark.parametrize("folder", python_folders())
def test_names_in_a_folder_say_what_they_name_and_its_comments_are_no_fragments(folder: str) -> None:
    most_names, most_fragments = LIBRARY_LIMITS if folder.startswith(("tacpipe", "stages")) else TEST_LIMITS
    names, names_percent, fragments, fragments_percent = plainness(python_folders()[folder])
    assert names_percent <= most_names, "\n".join(names[:40])
    assert fragments_percent <= most_fragments, "\n".join(fragments[:40])


def test_vague_names_and_fragments_are_counted_where_they_are_bound() -> None:
    source = (
        '"""What is made."""\n\ndef of(found, table):  # of a table\n    self._told = [one for one in found]\n'
        "    return self._told, other  # Rows of the table.\n"
    )
    names = [name for _, name in bound_names(ast.parse(source)) if name.strip("_") in VAGUE_NAMES]
    assert sorted(names) == ["_told", "found", "of", "one"]
    assert [text for _, text in comment_starts(source) if FRAGMENT.match(text)] == ["of a table", "What is made."]


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
