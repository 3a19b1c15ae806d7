"""Generate documentation pages: the command line, params of stages, Python, decisions, lists and result tables.

mkdocs calls ``on_files`` and ``on_page_markdown``; tests call the functions that return pages.
"""

from __future__ import annotations

import csv
import importlib
import os
import re
import sys
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parent
BUILT_IN = ("tacpipe.", "tacpipe_stages.")
ENTRY_POINTS = ("open", "load", "run", "Dataset", "Recording")  # listed at the top of the page on Python
MODELS = (
    "tacpipe.tasks.forward.prediction.ForwardModel",
    "tacpipe.tasks.material.model.MaterialModel",
    "tacpipe.tasks.touch.model.TouchModel",
)
BASE_CLASSES = {  # base class -> page with a complete example
    "tacpipe.tasks.task.Task": "task",
    "tacpipe.tasks.forward.params.ForwardModelParams": "model",
    "tacpipe.tasks.material.params.NetworkParams": "model",
    "tacpipe.tasks.learning.params.LearningParams": "model",
    "tacpipe.codecs.codec.FittedCodec": "codec",
    "tacpipe.sensors.sensor.Sensor": "sensor",
    "tacpipe.trackers.tracking.Tracker": "tracker",
    "tacpipe.engine.executors.local.Executor": "executor",
}
TABLE = re.compile(r"^\[\[(results|list): (\w+)\]\]$", re.MULTILINE)


def on_files(files: Any, config: Any) -> Any:
    """Add the generated pages to those in ``docs/``."""
    from mkdocs.structure.files import File

    for path, text in pages().items():
        files.append(File.generated(config, path, content=text))
    return files


def on_page_markdown(markdown: str, page: Any = None, **_: Any) -> str:
    """Insert tables at ``[[results: NAME]]`` and ``[[list: NAME]]``, and leave decisions out of the search index."""
    if page is not None and page.file.src_uri.startswith("decisions/"):
        page.meta["search"] = {"exclude": True}
    tables = {"results": result_table, "list": list_table}
    return TABLE.sub(lambda match: tables[match.group(1)](match.group(2)), markdown)


def pages() -> dict[str, str]:
    """Return the text of each generated page by path."""
    return {
        "reference/cli.md": command_line(),
        **{f"reference/cli/{name}.md": command_page(name) for name in command_families()},
        "reference/params.md": params(),
        "reference/python.md": python(),
        "reference/live-messages.md": live_messages(),
        "decisions/index.md": decisions(),
    }


def list_table(name: str) -> str:
    """Return the table of all ``tasks``, or of all ``formats`` that ``tacpipe ingest`` reads, from the registry."""
    from tacpipe.plugins import registry

    if name == "tasks":
        rows = [
            f"| [`{task}`](tasks/{task}.md) | {type(registry.load_task(task)).__doc__.splitlines()[0]} |"
            for task in registry.tasks()
        ]
        return "\n".join(["| task | what a model does |", "| --- | --- |", *rows])
    formats = [stage for stage in stage_names() if stage.startswith("ingest.")]
    rows = [f"| `{stage.replace('.', ' ')}` | {registry.summary(stage)} |" for stage in formats]
    return "\n".join(["| command | purpose |", "| --- | --- |", *rows])


def live_messages() -> str:
    """Return the page on messages of live sessions, from the declaration of each task."""
    from tacpipe.live import messages
    from tacpipe.plugins import registry

    tasks = {name: registry.load_task(name).live for name in registry.tasks()}
    return messages.reference_page({name: live.declaration for name, live in tasks.items() if live is not None})


def stage_names() -> list[str]:
    """Return the names of the built-in stages."""
    from tacpipe.plugins import registry

    return [name for name, target in registry.stages().items() if target.startswith(BUILT_IN)]


def command_line() -> str:
    """Return the page that lists all commands with links to their pages."""
    from tacpipe.cli import help as plain_help

    overview = help_of([])
    summaries = dict(re.findall(r"^  ([a-z]+) {2,}(.+)$", overview, re.MULTILINE))
    parts = [
        "# Command line\n",
        "Each page shows the help of one command, as printed by `tacpipe COMMAND --help`. `-h` prints "
        "only the common options. [Shared options](options.md) lists the options of several commands.\n",
    ]
    for title, names in plain_help.SECTIONS.items():
        parts += [f"## {title}\n", "| command | purpose |", "| --- | --- |"]
        parts += [f"| [`{name}`](cli/{name}.md) | {summaries[name]} |" for name in names]
        parts.append("")
    return "\n".join([*parts, "## Options without a command\n", f"```text\n{overview}\n```\n"])


def command_families() -> dict[str, list[list[str]]]:
    """Return the words of each command, grouped by the first word."""
    families: dict[str, list[list[str]]] = {}
    for words in command_names():
        families.setdefault(words[0], []).append(words)
    return families


def command_page(name: str) -> str:
    """Return the page with the help of a command or of a group of commands."""
    stages = stage_names()
    parts = []
    for words in command_families()[name]:
        parts += [f"{'##' if parts else '#'} tacpipe {' '.join(words)}\n"]
        if ".".join(words) in stages:
            parts.append(f"[Params of this stage](../params.md#{'-'.join(words)})\n")
        parts.append(f"```text\n{help_of(words)}\n```\n")
    return "\n".join(parts)


def command_names() -> list[list[str]]:
    """Return the words of every command; the commands of a group follow the group."""
    from tacpipe.cli import commands
    from tacpipe.plugins import registry

    names: list[list[str]] = []
    groups: dict[str, list[str]] = {}
    for name in stage_names():
        group, _, method = name.partition(".")
        groups.setdefault(group, []).append(method)
    for group in [name for name in registry.commands() if name in groups]:
        names.append([group])
        names += [[group, method] for method in groups[group] if method]
    for name in commands.NAMES:
        names.append([name])
        names += [[name, verb] for verb in _verbs(name)]
    return names


def _verbs(name: str) -> list[str]:
    listed = help_of([name]).split("\nCommands:\n")
    return re.findall(r"^  ([a-z-]+) ", listed[1], re.MULTILINE) if len(listed) > 1 else []


def help_of(words: list[str]) -> str:
    """Return the output of ``tacpipe WORDS --help``, 100 columns wide."""
    import typer

    from tacpipe.cli import help as plain_help
    from tacpipe.cli import main

    arguments = [*words, "--help"]
    saved_argv, columns = sys.argv, os.environ.get("COLUMNS")
    sys.argv, os.environ["COLUMNS"] = ["tacpipe", *arguments], "102"
    try:
        program = main.app(arguments)
        plain_help.apply(program, brief=False)
        command: Any = typer.main.get_command(program)
        context = command.make_context("tacpipe", [], resilient_parsing=True)
        for word in words:
            command = command.get_command(context, word)
            context = command.make_context(word, [], parent=context, resilient_parsing=True)
        text: str = command.get_help(context)
    finally:
        sys.argv = saved_argv
        if columns is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = columns
    return text.strip()


def params() -> str:
    """Return the page on the params of all stages, with meaning, values and default."""
    from tacpipe.plugins import registry

    parts = [
        "# Params of every stage\n",
        "A param can be set with an option (`--learning-rate 0.001`), a line of `params.yaml` (`learning_rate: 0.001`) or "
        "`--set learning_rate=0.001`. All params of a stage are part of its key.\n",
    ]
    for name in stage_names():
        stage = registry.load(name)
        rows = param_rows(stage)
        parts.append(f"## {name.replace('.', ' ')}\n\n{registry.summary(name)}\n")
        if not rows:
            parts.append("No params.\n")
            continue
        parts.append("| param | values | default | meaning |\n| --- | --- | --- | --- |")
        parts += [f"| {' | '.join(row)} |" for row in rows]
        parts.append("")
    return "\n".join(parts)


def param_rows(stage: Any) -> list[list[str]]:
    """Return Markdown cells with name, values, default and meaning of each param of a stage."""
    from tacpipe.plugins import fields
    from tacpipe.plugins import params as stage_params

    comments = stage_params.comments(stage)
    rows = []
    for name, field in stage_params.fields(stage).items():
        default = " or ".join(f"`{value}`" if value != "" else "empty" for value in stage_params.defaults(stage, name))
        text = comments.get(name, "")
        if owners := stage_params.choices_with(stage, name):
            text = f"{text}; only with {stage_params.tag(stage)} {', '.join(map(str, owners))}".lstrip("; ")
        rows.append([f"`{name}`", _cell(fields.describe(field)), default, _cell(text)])
    return rows


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ").replace("<", "&lt;")


def python() -> str:
    """Return the page on the Python interface: entry points, models, base classes of plug-ins, then errors."""
    import tacpipe

    parts = [
        "# Python\n",
        "This page lists the public names of `tacpipe` and the constraints for params. "
        "[From Python](../python.md) explains them with examples.\n",
    ]
    public = [name for name in tacpipe.__all__ if not name.startswith("__")]
    errors = [name for name in public if name.endswith(("Error", "Warning"))]
    others = sorted({*public} - {*ENTRY_POINTS, *errors}, key=str.lower)
    parts += [_entry(_path(name)) for name in ENTRY_POINTS]
    parts.append("## Models\n\n`tacpipe.load` returns one of these classes.\n")
    parts += [_entry(path, 3) for path in MODELS]
    parts.append(
        "## Base classes of plug-ins\n\nFormats, stages and exports are functions with the decorator `stage`: "
        "[A format](../extending/format.md), [A stage](../extending/stage.md), [An export](../extending/export.md).\n"
    )
    for path, page in BASE_CLASSES.items():
        parts += [_entry(path, 3), f"[A complete example](../extending/{page}.md)\n"]
    parts += [_entry(_path(name)) for name in (*others, *sorted(errors))]
    parts.append(
        "## Constraints of params\n\n::: tacpipe.plugins.constraints\n    options:\n      show_root_heading: false\n"
        "      filters: ['!^_', '!^allows$', '!^describe$']\n"
    )
    return "\n".join(parts)


def _entry(path: str, level: int = 2) -> str:
    """Return the instruction for mkdocstrings that inserts the docstring at ``path``."""
    return f"::: {path}\n    options:\n      heading_level: {level}\n"


def _path(name: str) -> str:
    """Return the path of the definition of a public name, for mkdocstrings."""
    tacpipe: Any = importlib.import_module("tacpipe")
    value = getattr(tacpipe, name)
    module = getattr(value, "__module__", None)
    qualified_name = getattr(value, "__qualname__", name)
    return f"{module}.{qualified_name}" if module and module.startswith("tacpipe") else f"tacpipe.{name}"


def decisions() -> str:
    """Return the list of decisions, oldest first."""
    lines = ["# Decisions\n", "Each page explains one design decision, with its alternatives and measurements.\n"]
    for page in sorted((DOCS / "decisions").glob("[0-9]*.md")):
        if page.stem.startswith("0000"):
            continue
        title = page.read_text(encoding="utf-8").splitlines()[0].lstrip("# ")
        lines.append(f"- [{title}]({page.name})")
    return "\n".join([*lines, ""])


def result_table(name: str) -> str:
    """Return a table of ``docs/results/`` as Markdown."""
    with (DOCS / "results" / f"{name}.csv").open(encoding="utf-8") as file:
        head, *rows = list(csv.reader(file))
    lines = [f"| {' | '.join(word.replace('_', ' ') for word in head)} |", f"|{' --- |' * len(head)}"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])
