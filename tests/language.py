"""Advise on the words of the project: `make language` prints the places where plainer language may be better.

It prints words that the glossary of CONTRIBUTING.md replaces, names that fit anything, and comments that begin as
fragments. It is advice and fails nothing, because each word is right somewhere.
"""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

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
NAMES = re.compile(
    r"(?:^|_)(?:foretell|foretold|tells?|told|judg(?:e|ed|es|ing)|mend(?:ed|s)?|wish(?:es|ed)?|heeds?|heeded|"
    r"believed?|claim(?:s|ed)?|strangers?|felt)(?:_|$)|^_?(?:Told|Tell|Telling|Felt|Judged|Wishes|Mended)$"
)
FOLDERS = ("tacpipe", "stages", "tests", "benchmarks", "fuzz")


def find_unused_words(text: str) -> list[str]:
    """Return each word that is not used, with its context; code is left out."""
    prose = " ".join(re.sub(r"`[^`\n]*`|^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE).split())
    return [prose[max(0, match.start() - 30) : match.end() + 20].strip() for match in WORDS.finditer(prose)]


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


def explanations(source: str) -> Iterator[str]:
    """Yield the docstrings and the comments of a module."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield ast.get_docstring(node) or ""
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    yield from (token.string for token in tokens if token.type == tokenize.COMMENT)


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


def advise_on_page(path: Path) -> Iterator[str]:
    """Yield one line per word of a page that is not used."""
    yield from (f"{path.relative_to(ROOT)}: {spot}" for spot in find_unused_words(path.read_text(encoding="utf-8")))


def advise_on_module(path: Path) -> Iterator[str]:
    """Yield one line per word, vague name and fragment of a module."""
    source, place = path.read_text(encoding="utf-8"), path.relative_to(ROOT)
    tree = ast.parse(source)
    for text in (*error_messages(tree), *explanations(source)):
        yield from (f"{place}: {spot}" for spot in find_unused_words(text))
    for line, name in bound_names(tree):
        if NAMES.search(name) or name.strip("_") in VAGUE_NAMES:
            yield f"{place}:{line}: the name {name} fits anything"
    for line, text in comment_starts(source):
        if FRAGMENT.match(text):
            yield f"{place}:{line}: a fragment: {text:.60}"


def main() -> None:
    """Print all advice and the number of its lines."""
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
    lines = [line for page in pages for line in advise_on_page(page)]
    modules = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]
    lines += [line for path in modules for line in advise_on_module(path)]
    print(*lines, f"{len(lines)} places to look at", sep="\n")


if __name__ == "__main__":
    main()
