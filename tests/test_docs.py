"""Texts and help are true: commands run as printed, paths exist, examples parse."""

import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import pytest

from tacpipe.cli import commands
from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tests.conftest import Lab, run_python, tacpipe, write_plugin

ROOT = Path(__file__).parents[1]
DOCS = sorted(page for page in (ROOT / "docs").rglob("*.md") if page.name != "0000-template.md")
PAGES = [ROOT / "README.md", ROOT / "data" / "README.md", *DOCS]
RUN = [  # pages whose console and Python blocks are run, in this order, in one project
    ROOT / "README.md",
    *(
        ROOT / "docs" / f"{name}.md"
        for name in (
            "quickstart",
            "tutorials/simulated",
            "tutorials/compare",
            "tutorials/newtons",
            "tutorials/own-data",
            "howto/hdf5",
            "howto/view",
            "howto/report",
            "howto/export",
            "tutorials/ci-and-dvc",
            "howto/python",
        )
    ),
    *sorted((ROOT / "docs" / "tasks").glob("*.md")),
]
EXTENDING = [  # pages whose packages tests/test_extending.py installs and whose blocks it runs, in this order in one project
    ROOT / "docs" / "extending" / f"{name}.md"
    for name in (
        "model",
        "codec",
        "encoder",
        "task",
        "tracker",
        "executor",
        "export",
        "check",
        "stage",
        "format",
        "sensor",
    )
]
PYTHON = ROOT / "docs" / "python.md"  # tests/test_python_page.py runs its blocks.
BUILT_IN = sorted(
    name for name, target in registry.stages().items() if target.startswith(("tacpipe.", "tacpipe_stages."))
)
SENSORS = ("list", "probe", "emulate")
STORE = ("status", "verify", "repair", "gc", "link", "push", "pull")
COMMANDS = [
    *(name.replace(".", " ") for name in BUILT_IN),
    *(name for name in commands.NAMES if name not in ("sensors", "store")),
    *(f"sensors {name}" for name in SENSORS),
    *(f"store {name}" for name in STORE),
]


def blocks(text: str, language: str) -> list[str]:
    """Return the fenced blocks of a language."""
    code_blocks: list[str] = re.findall(rf"^```{language}[^\n]*\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    return code_blocks


def section(text: str, title: str) -> str:
    """Return the text below a heading of the second level."""
    return text.split(f"\n## {title}\n")[1].split("\n## ")[0]


@dataclass(frozen=True)
class Block:
    """A fenced block, the file that it is to be saved as, and why it is not run."""

    language: str
    text: str
    title: str = ""
    mark: str = ""


def fenced_blocks(text: str) -> list[Block]:
    """Return the fenced blocks of a page, with the comment ``<!-- not run: REASON -->`` above one as its mark."""
    matches = re.findall(
        r'(?:^<!-- not run: ([^\n]+) -->\n)?^```(\w+)(?: title="([^"]+)")?\n(.*?)^```$', text, re.DOTALL | re.MULTILINE
    )
    return [Block(language, code, title, mark) for mark, language, title, code in matches]


def join_parts(text: str) -> str:
    """Return commands that continue on the next line as one line each."""
    return re.sub(r" *\\\n +", " ", text)


MORE = "…"  # This stands in a page for further lines that a command prints.


def printed_commands(block: str) -> list[tuple[str, list[str]]]:
    """Return the commands of a console block, each with the lines that are printed below it, but for empty ones."""
    outputs: list[tuple[str, list[str]]] = []
    for line in join_parts(block).splitlines():
        if line.startswith("$ "):
            outputs.append((line.removeprefix("$ "), []))
        elif line:
            outputs[-1][1].append(line)
    return outputs


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_of_every_command_has_examples_of_one_line_that_parse(command: str, lab: Lab) -> None:
    text = lab.run(f"{command} --help").out
    examples = re.split(r"\nExamples?:\n", text)[1].split("\n\n")[0].splitlines()

    for example in examples:
        words = shlex.split(example)
        assert words[0] == "tacpipe"
        assert words[1 : 1 + len(command.split())] == command.split()
        lab.run(shlex.join([*words[1:], "--help"]))  # an option or command that does not exist is refused


@pytest.mark.parametrize("name", BUILT_IN)
def test_every_stage_has_a_summary_that_is_a_sentence(name: str) -> None:
    text = registry.summary(name)

    assert re.fullmatch(r"[A-Z].{8,}\.", text)
    assert len(text) < 60


def test_every_other_command_and_group_has_a_summary_that_is_a_sentence() -> None:
    texts = {**registry.commands(), **{name: commands.summary(name) for name in commands.NAMES}}

    assert {name.partition(".")[0] for name in BUILT_IN if "." in name} <= set(texts)
    assert not [name for name, text in texts.items() if not re.fullmatch(r"[A-Z].+\.", text)]


@pytest.mark.long
@pytest.mark.minutes
def test_the_commands_and_python_of_every_page_run_and_print_what_it_says(tmp_path: Path) -> None:
    """One project folder serves all pages, so what one page computed is reused on the next."""
    project = tmp_path / "project"
    project.mkdir()
    environment = {"PYTHONPATH": str(tmp_path), "TACPIPE_STORE": str(tmp_path / "store"), "OMP_NUM_THREADS": "1"}
    before: set[str] = set()  # commands of earlier pages

    for page in RUN:
        page_blocks = [block for block in fenced_blocks(page.read_text()) if not block.mark]
        for name, text in entry_points(page_blocks):
            write_plugin(tmp_path, name, text)
        page_commands: set[str] = set()
        for block in page_blocks:
            if block.title:
                (tmp_path if block.title.endswith(".py") else project).joinpath(block.title).write_text(block.text)
            elif block.language == "python":
                run_block(page, block.text, project, environment)
            elif block.language == "console":
                for command, lines in printed_commands(block.text):
                    ran = tacpipe(project, command.removeprefix("tacpipe "), **environment)
                    assert ran.returncode == 0, f"{page.name}: {command}: {ran.stderr}"
                    lines_printed = [line for line in (ran.stderr + ran.stdout).splitlines() if line]
                    compare(f"{page.name}: {command}", lines, lines_printed, rerun=command in before)
                    page_commands.add(command)
        before |= page_commands


def compare(name: str, lines: list[str], printed_lines: list[str], *, rerun: bool) -> None:
    """Require that a command printed the lines of its page; seconds differ, and reuse where it ran as a ``rerun``."""
    printed_lines = [line for line in printed_lines if not line.startswith("tacpipe: created the store ")]
    seconds, counts = re.compile(r"\d+\.\d s$"), re.compile(r"^\d+ ran, \d+ reused, ")
    expected, actual = ([seconds.sub("", line) for line in lines_of_side] for lines_of_side in (lines, printed_lines))
    if rerun:  # An earlier page computed it already.
        expected = ["reused" if counts.match(line) else line for line in expected]
        actual = ["reused" if counts.match(line) and line.startswith("0 ran") else line for line in actual]
    if MORE in expected:  # lines whose numbers are another machine's
        at = expected.index(MORE)
        after = len(expected) - at - 1
        assert len(actual) >= len(expected) - rerun, name  # a hit prints nothing of a training
        actual = [*actual[:at], MORE, *actual[len(actual) - after :]]
    assert actual == expected, name


def run_block(page: Path, text: str, folder: Path, environment: dict[str, str]) -> None:
    """Require that a Python block runs."""
    process = run_python(folder, "-c", text, environment=environment)
    assert process.returncode == 0, f"{page.name}: {process.stderr}"


def entry_points(page_blocks: list[Block]) -> list[tuple[str, str]]:
    """Return name and ``entry_points.txt`` of each block of entry points."""
    files = []
    for block in page_blocks:
        if block.language == "toml" and block.text.startswith("[project.entry-points"):
            text = block.text.replace("[project.entry-points.", "[").replace('"', "")
            files.append((text.split()[1].replace("-", "_"), text))
    return files


def test_every_block_of_commands_or_python_runs_or_states_why_it_does_not() -> None:
    unmarked = [
        f"{page.name}: {block.text[:60]}"
        for page in PAGES
        for block in fenced_blocks(page.read_text())
        if block.language in ("sh", "console", "python")
        and not block.mark
        and (page not in (*RUN, *EXTENDING, PYTHON) or block.language == "sh")
    ]
    reasons = [block.mark for page in PAGES for block in fenced_blocks(page.read_text()) if block.mark]

    assert unmarked == []
    assert len(reasons) >= 10 and all(len(reason) > 10 for reason in reasons)
    assert sum(block.language == "console" for page in RUN for block in fenced_blocks(page.read_text())) >= 10


def test_what_pages_use_of_the_library_exists() -> None:
    missing = []
    for page in PAGES:
        text = page.read_text()
        for module_name, words in re.findall(r"^ *from (tacpipe[.\w]*) import (.+)$", text, re.MULTILINE):
            module = importlib.import_module(module_name)
            folder = Path(module.__file__ or "").parent
            for name in (word.split(" as ")[0].strip(" ()") for word in words.split("#")[0].split(",")):
                if (folder / f"{name}.py").exists():
                    imported = importlib.import_module(f"{module_name}.{name}")
                    attributes = set(re.findall(rf"(?<![\w.]){name}\.(\w+)\(", text))
                    missing += [f"{page.name}: {name}.{attribute}" for attribute in attributes - set(dir(imported))]
                elif name and not hasattr(module, name):
                    missing.append(f"{page.name}: {module_name}.{name}")
    assert missing == []


def test_the_commands_in_all_pages_exist(lab: Lab) -> None:
    lines_of_pages = []
    for page in PAGES:
        text = page.read_text()
        lines = [line.split("#")[0] for block in blocks(text, "sh") for line in join_parts(block).splitlines()]
        lines_of_pages += [line for line in lines if line.startswith("tacpipe ")] + re.findall(
            r"`(tacpipe [^`]+)`", text
        )
    command_words = [
        words for line in dict.fromkeys(lines_of_pages) if (words := shlex.split(re.sub(r"\.\.\.|<TAB>", "", line)))
    ]
    assert len(command_words) >= 40

    for words in command_words:
        if not words[1][0].isupper():  # `tacpipe COMMAND --help`
            lab.run(shlex.join([*words[1:], *([] if {"--help", "--version"} & set(words) else ["--help"])]))


def test_the_file_tree_of_contributing_names_what_is_there_and_every_package() -> None:
    (tree,) = blocks(section((ROOT / "CONTRIBUTING.md").read_text(), "Files and folders"), "text")
    paths = {path for line in tree.splitlines() for path in re.split(r", ", re.split(r"\s{2,}", line)[0])}
    packages = {f"tacpipe/{path.parent.name}/" for path in (ROOT / "tacpipe").glob("*/__init__.py")}

    assert not [path for path in paths if not (ROOT / path).exists()]
    assert packages <= paths


def test_the_readme_is_short_and_its_picture_small() -> None:
    text = (ROOT / "README.md").read_text()
    pictures = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)

    assert len(text.splitlines()) < 150
    assert len(pictures) == 1
    for picture in (ROOT / "docs" / "images").iterdir():
        assert picture.stat().st_size < 150_000
    assert (ROOT / pictures[0]).exists()


def hooks() -> ModuleType:
    return module("hooks")


def module(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"docs_{name}", ROOT / "docs" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = loaded  # dataclasses look their module up there
    spec.loader.exec_module(loaded)
    return loaded


def test_the_reference_has_a_page_for_every_command_with_the_help_that_it_prints(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    reference = hooks()
    pages, navigation = reference.pages(), (ROOT / "mkdocs.yml").read_text()
    monkeypatch.setenv("COLUMNS", "102")

    assert set(COMMANDS) <= {" ".join(words) for words in reference.command_names()}
    for name in reference.command_families():
        assert f"{name}: reference/cli/{name}.md" in navigation
        assert f"(cli/{name}.md)" in pages["reference/cli.md"]
    for command in ("synchronize", "store gc", "train forward", "acquire"):
        assert lab.run(f"{command} --help").out.strip() in pages[f"reference/cli/{command.split()[0]}.md"]


def test_the_reference_has_every_param_of_every_stage() -> None:
    page = hooks().params()

    for name in BUILT_IN:
        part = page.split(f"\n## {name.replace('.', ' ')}\n")[1].split("\n## ")[0]
        for field in params_of.fields(registry.load(name)):
            assert f"| `{field}` |" in part


def test_the_tables_of_results_are_on_the_page_and_have_their_picture() -> None:
    documentation, text = hooks(), (ROOT / "docs" / "results.md").read_text()
    tables = sorted(path.stem for path in (ROOT / "docs" / "results").glob("*.csv"))
    page = documentation.on_page_markdown(text)

    assert tables == ["forward", "material", "published", "touch"]
    for name in module("pictures").TITLES:
        rows = module("pictures").rows(name)
        assert 3 <= len(rows) <= 7
        assert all(float(row["low"]) <= module("pictures").value_of(row) <= float(row["high"]) for row in rows)
        assert rows[0]["method"] in page and f"images/{name}.png" in page


def test_lists_of_tasks_and_formats_are_those_of_the_registry() -> None:
    page = hooks().on_page_markdown("[[list: tasks]]\n\n[[list: formats]]\n")
    assert all(f"[`{task}`](tasks/{task}.md)" in page for task in registry.tasks())
    assert all(f"`{name.replace('.', ' ')}`" in page for name in BUILT_IN if name.startswith("ingest."))


PARSED = {  # beginnings of examples of the help that are parsed and not run, and why
    "acquire": "needs the devices of a rig",
    "candidates": "names a published grasp",
    "demo": "runs for minutes, and the examples here do the same",
    "extract": "needs the recording of a camera; tests/stages/test_extract.py has such recordings",
    "ingest": "needs files of other programs; tests/formats reads such files",
    "live": "needs the devices of a rig",
    "sensors emulate": "runs until Ctrl-C",
    "try": "needs files of a lab; tests/test_first_try.py runs it on some",
    "sensors probe": "needs a device",
    "store checkout": "names the digest of another store",
    "store pull": "needs another store",
    "store push": "needs a bucket",
    "store verify --remote": "needs a bucket",
    "track": "needs an extra",
    "view": "opens a window",
}
PREPARED = {  # commands that must run before the example of a command
    "segment losses": ("label data/gels trial-* --label slip=true", "extract difference data/gels -o data/difference"),
    "segment slips": (
        "synchronize data/recordings -o data/even --rate-hz 50",
        "segment contacts data/even -o data/even-contacts",
    ),
    "train classify": ("split data/grasps -o data/grasps-split --stratify object",),
    "train material": ("split data/slides -o data/slides-split --stratify sensor,material",),
    "recentre": (
        "simulate touch --trials 4 --objects 1 -o data/pinched-today",
        "segment grasps data/pinched-today -o data/today",
        "train classify data/grasps --split data/grasps-split --label object --architecture linear --recentre sensor "
        "-o models/object",
    ),
    "compare": ("evaluate models/forward data/segments --split data/split -o results/forward-gru",),
}
SHORT = """
train: {forward: {epochs: 1, stride: 8}, material: {features: 500}, touch: {trees: 10, baselines: false},
  regress: {stride: 20, architecture: linear}, classify: {stride: 20, architecture: linear}, slip: {architecture: linear}}
compress: {autoencoder: {epochs: 1, search: 0}}
"""
CHAIN = "stages: {train: {cmd: tacpipe version}, evaluate: {cmd: tacpipe version}, forward: {cmd: tacpipe version}}"


@pytest.mark.long
@pytest.mark.minutes
def test_the_examples_of_all_help_texts_run_as_pasted(tmp_path: Path) -> None:
    """They run in the order of the reference, in one project whose ``params.yaml`` makes trainings short."""
    (tmp_path / ".tacpipe").mkdir()
    (tmp_path / "params.yaml").write_text(SHORT)
    (tmp_path / "dvc.yaml").write_text(CHAIN)
    reference, count = hooks(), 0
    failures: dict[str, str] = {}
    environment = {"OMP_NUM_THREADS": "1", "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}

    for words in reference.command_names():
        texts = re.split(r"\nExamples?:\n", reference.help_of(words))[1:]
        for example in "".join(texts).split("\n\n")[0].splitlines():
            command = " ".join(shlex.split(example, comments=True)[1:])
            if command.startswith(tuple(PARSED)):
                continue
            for line in (*PREPARED.get(" ".join(words), ()), command):
                process = tacpipe(tmp_path, line, **environment)
                if process.returncode:
                    failures[line] = process.stderr
            count += 1
    assert failures == {}
    assert count >= 40


def test_every_page_is_in_the_navigation_and_every_link_leads_to_a_page() -> None:
    navigation = (ROOT / "mkdocs.yml").read_text()
    generated = set(hooks().pages())
    for page in DOCS:
        path = page.relative_to(ROOT / "docs").as_posix()
        assert path in navigation or path.startswith("decisions/"), path
        for target in re.findall(r"\]\(([^)#:]+?)(?:#[^)]*)?\)", page.read_text()):
            place = (page.parent / target).resolve()
            assert place.exists() or place.relative_to(ROOT / "docs").as_posix() in generated, f"{path}: {target}"


WIDTH = 76  # characters of a command line that fit a block of code on the site
QUESTIONS = {  # Questions of users, each with the page and the heading of the answer.
    "How do I record two sensors?": ("tutorials/rig.md", "Your first rig: two sensors"),
    "How do I read my CSV files?": ("tutorials/own-data.md", "Your own CSV files"),
    "What does synchronize do to timestamps?": ("explanation/recording.md", "Two clocks"),
    "Which forward model is best?": ("howto/choose-model.md", "Choose a model"),
    "How do I run on Slurm?": ("howto/cluster.md", "Use Slurm"),
    "How do I clean the store?": ("howto/data.md", "Manage data and the store"),
    "How do I get data into LeRobot?": ("howto/export.md", "LeRobot"),
    "Can I trust the cache?": ("explanation/guarantees.md", "Guarantees"),
    "How do I add my sensor?": ("howto/board.md", "Connect your own board"),
    "How do I use my network?": ("extending/model.md", "A model"),
    "How do I label slips?": ("howto/label.md", "Slips"),
    "What does skill mean?": ("reference/metrics.md", "What skill means"),
    "How do I get forecasts live?": ("tutorials/live.md", "Forecast live"),
    "How do I share a dataset?": ("howto/push.md", "Push and pull datasets"),
    "How do I cite tacpipe?": ("../README.md", "More"),
}
ANSWERS = {  # a part of the answer, which the section must contain
    "How do I run on Slurm?": "--executor slurm",
    "How do I clean the store?": "tacpipe store gc",
    "Which forward model is best?": "taxelwise",
    "How do I label slips?": "segment slips",
    "How do I get data into LeRobot?": "observation.state",
    "How do I cite tacpipe?": "CITATION.cff",
    "What does skill mean?": "1 − error",
    "What does synchronize do to timestamps?": "synchronize",
}


def within_links(count: int) -> set[Path]:
    """Return the pages that are at most ``count`` links from the README."""
    reached = {ROOT / "README.md"}
    for _ in range(count):
        for page in list(reached):
            targets = re.findall(r"\]\(([^)#\s]+\.md)(?:#[^)]*)?\)", page.read_text())
            reached |= {path for target in targets if (path := (page.parent / target).resolve()).exists()}
    return reached


@pytest.mark.parametrize("question", QUESTIONS)
def test_a_question_has_one_heading_with_its_answer_at_most_two_links_from_the_readme(question: str) -> None:
    name, heading = QUESTIONS[question]
    page = (ROOT / "docs" / name).resolve()
    text = "\n" + page.read_text()
    (start,) = re.finditer(rf"^(#+) {re.escape(heading)}$", text, re.MULTILINE)
    answer = re.split(rf"^#{{1,{len(start[1])}}} ", text[start.end() :], maxsplit=1, flags=re.MULTILINE)[0]

    assert page in within_links(2)
    assert ANSWERS.get(question, "") in answer


def test_every_page_is_at_most_two_links_from_the_readme() -> None:
    pages = {page for page in DOCS if page.parent.name != "decisions"}
    assert {str(page.relative_to(ROOT)) for page in pages - within_links(2)} == set()


def test_pages_are_short() -> None:
    """Count words outside of code; troubleshooting is a table to look up."""
    longest = {
        "tutorials": 900,
        "howto": 600,
        "explanation": 1000,
        "tasks": 1000,
        "quickstart.md": 500,
        "concepts.md": 700,
    }
    limits = {page: longest.get(page.name, longest.get(page.parent.name)) for page in DOCS}
    counts = {
        page: len(re.sub(r"^```.*?^```$|<!--.*?-->", "", page.read_text(), flags=re.DOTALL | re.MULTILINE).split())
        for page in DOCS
    }
    long_pages = {page.name: counts[page] for page, limit in limits.items() if limit and counts[page] > limit}
    assert set(long_pages) <= {"troubleshooting.md"}
    assert len((ROOT / "README.md").read_text().split()) <= 600
    assert len((ROOT / "CHANGELOG.md").read_text().split()) <= 900


def test_decisions_follow_one_template_with_a_date() -> None:
    sections = re.compile(r"^## (.+)$", re.MULTILINE)
    template = sections.findall((ROOT / "docs" / "decisions" / "0000-template.md").read_text())
    pages = [page for page in DOCS if page.parent.name == "decisions"]
    assert len(pages) >= 50
    for page in pages:
        text = page.read_text()
        titles = sections.findall(text)
        assert re.match(rf"# {page.name[:4]}: .+\n\nDate: 20\d\d-\d\d-\d\d\. Status: ", text), page.name
        assert titles in (template, [title for title in template if title != "Alternatives"]), page.name


def test_command_lines_fit_a_block_of_code() -> None:
    long_lines = [
        f"{page.name}: {line}"
        for page in PAGES
        for block in fenced_blocks(page.read_text())
        if block.language in ("sh", "bash", "console")
        for line in block.text.splitlines()
        if len(line) > WIDTH and (block.language != "console" or line.startswith("$ "))
    ]
    assert long_lines == []


def test_pages_avoid_words_of_a_translation() -> None:
    text = "\n".join(page.read_text() for page in PAGES if page.parent.name != "decisions")
    prose = re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)

    assert len(re.findall(r"\balone\b", prose, re.IGNORECASE)) <= 10
    assert re.findall(r"\b(?:anew|whoever|what lies|besides|a row a recording)\b", prose, re.IGNORECASE) == []


@pytest.mark.long
def test_the_notebook_opens_a_dataset_and_fits_a_model(tmp_path: Path) -> None:
    (tmp_path / ".tacpipe").mkdir()
    (block, *_) = fenced_blocks(section((ROOT / "README.md").read_text(), "From data to a report"))
    for command, _ in printed_commands(block.text)[:4]:
        ran = tacpipe(tmp_path, command.removeprefix("tacpipe "), OMP_NUM_THREADS="1")
        assert ran.returncode == 0, ran.stderr
    cells = json.loads((ROOT / "docs" / "tutorials" / "explore.ipynb").read_text())["cells"]
    code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    process = run_python(tmp_path, "-c", code, environment={"MPLBACKEND": "Agg"})
    assert process.returncode == 0, process.stderr
    assert re.fullmatch(r"own model [\d.]+ counts, persistence [\d.]+ counts, skill \+0\.\d\d\n", process.stdout)


@pytest.mark.long
@pytest.mark.skipif(importlib.util.find_spec("mkdocs") is None, reason="the extra docs is not installed")
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    build = ("-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(tmp_path / "site"))
    process = run_python(ROOT, *build, environment={"NO_MKDOCS_2_WARNING": "1"})
    assert process.returncode == 0, process.stderr
    assert "tacpipe synchronize" in (tmp_path / "site" / "reference" / "cli" / "synchronize.html").read_text()
    assert (tmp_path / "site" / "reference" / "python.html").read_text().count("doc-heading") > 5


def test_the_targets_that_the_texts_name_are_in_the_makefile() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    pages = [*PAGES, ROOT / "CONTRIBUTING.md"]
    targets_in_texts = {
        name for page in pages for name in re.findall(r"(?:^|`)make ([a-z-]+)", page.read_text(), re.MULTILINE)
    }

    assert {"demo", "test", "lint", "types", "bench"} <= targets_in_texts
    assert targets_in_texts <= targets


def test_the_install_commands_of_the_texts_work_without_a_package_index() -> None:
    about = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wheel = f"./{about['name']}-{about['version']}-py3-none-any.whl"
    install_commands = [
        words
        for page in PAGES
        for line in re.findall(r"(?:^|`)(pip (?:install|wheel) [^`#\n]+)", page.read_text(), re.MULTILINE)
        for words in [shlex.split(line)]
    ]
    assert len(install_commands) >= 6

    for words in install_commands:
        if words[1] == "wheel":
            assert words == ["pip", "wheel", "--no-deps", "-w", "dist", "."]
            continue
        source, _, extras = words[-1].rstrip("]").partition("[")
        assert source in (".", wheel), " ".join(words)  # a name alone is looked up in an index
        assert set(extras.split(",")) - {""} <= set(about["optional-dependencies"])


def test_what_runs_where_is_as_contributing_states() -> None:
    text, make, ran = ((ROOT / name).read_text() for name in ("CONTRIBUTING.md", "Makefile", ".ci/run"))
    (targets,) = re.findall(r"^for target in (.+); do$", ran, re.MULTILINE)
    first = text.split("\n\n")[1]

    for words in shlex.split(targets):
        target, _, options = re.sub(r"\$\(\(commits % \d+ \+ 1\)\)", "2", words).partition(" ")
        assert f"{target}:" in make and f"make {target}" in first
        assert f"`make {target}{options and ' ' + options}`" in text
    for marker in ("long", "rig", "faults"):
        assert (
            f"`{marker}`" in section(text, "Tests") and f"make test-{marker}" in (ROOT / "pyproject.toml").read_text()
        )


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_make_says_in_one_sentence_that_python_is_missing(tmp_path: Path) -> None:
    (tmp_path / "bin").mkdir()
    for name in ("bash", "make", "touch"):
        (tmp_path / "bin" / name).symlink_to(str(shutil.which(name)))
    process = subprocess.run(
        ["make", "-C", str(ROOT), f"VENV={tmp_path / 'venv'}", "SHELL=bash", str(tmp_path / "venv" / ".python")],
        env={"PATH": str(tmp_path / "bin")},
        capture_output=True,
        text=True,
        check=False,
    )

    assert process.returncode != 0
    assert "Python 3.11 or newer is missing" in process.stderr
    assert not (tmp_path / "venv").exists()


def test_help_of_a_command_that_a_test_runs_is_the_page_s(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "102")
    assert lab.run("show --help").out.strip() == hooks().help_of(["show"])
