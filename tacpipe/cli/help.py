"""Render ``--help``, with options in panels, and ``-h`` on one screen; refuse addresses, such as ``s3://``, as paths."""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from tacpipe.io.files import local

REQUIRED, PARAMS, RUN, OUTPUT, OPTIONS = "Required", "Params", "Run", "Output", "Options"
PANELS = {  # Panels of the options that commands share. The params of a stage name theirs.
    **dict.fromkeys(("preset", "params_file", "block", "set_", "print_params"), PARAMS),
    **dict.fromkeys(("split", "fold", "role", "codec", "init", "extend"), "Data"),
    **dict.fromkeys(("jobs", "executor", "skip_bad", "check", "compare", "rerun", "replace", "dry_run"), RUN),
    **dict.fromkeys(("output", "json_", "as_json", "quiet", "help"), OUTPUT),
}
LAST = (PARAMS, RUN, OUTPUT)  # Panels that follow all others.
COMMON = (
    "architecture",
    "epochs",
    "seed",
    "preset",
    "fold",
    "role",
    "device",
    "jobs",
    "check",
    "replace",
    "json_",
    "help",
)
# Earlier names of options. They still work, and no help shows them.
OLD_NAMES = {"--duration": "--duration-s", "--set": "--label", "--store": "--remote"}
EXAMPLE = "Example: "  # Starts a paragraph with a command line, which is printed without line breaks.
BRIEF_LINES = 40  # Lines that ``-h`` prints at most.
TYPES = {"integer": "INTEGER", "int": "INTEGER", "float": "NUMBER", "path": "PATH", "file": "PATH"}
SECTIONS = {  # Commands in the order in which ``tacpipe --help`` lists them. Stages of other packages follow.
    "Record": ("acquire", "live", "sensors"),
    "Import and export": ("ingest", "simulate", "export"),
    "Prepare": ("extract", "synchronize", "segment", "split", "compress", "label"),
    "Train and evaluate": ("train", "calibrate", "evaluate", "predict", "compare", "report", "track"),
    "Look": ("show", "view", "explain", "candidates", "limits"),
    "Manage": ("run", "store", "demo", "version"),
}
PLUG_INS = "Plug-ins"


class PanelCommand(TyperCommand):
    """A command whose help shows its options in panels: the one an option names, else that of `PANELS`."""

    brief = False  # True shows only the common options.

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse a command line, in which options may have the names of `OLD_NAMES` where the command has none of them."""
        options = {name for param in self.params for name in (*param.opts, *param.secondary_opts)}
        renamed = {old: new for old, new in OLD_NAMES.items() if new in options and old not in options}
        end = args.index("--") if "--" in args else len(args)
        words = [word.partition("=") for word in args[:end]]
        return super().parse_args(
            ctx, ["".join((renamed.get(name, name), *value)) for name, *value in words] + args[end:]
        )

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return what follows the command's name: arguments, required options, and a word for the others."""
        params = self.get_params(ctx)
        arguments = [_argument_name(param) for param in params if param.param_type_name == "argument"]
        required = [
            f"{min(param.opts, key=len)} {_metavar(param, ctx)}"
            for param in params
            if param.param_type_name == "option" and _panel(param) == REQUIRED
        ]
        return [*arguments, *required, "[OPTIONS]"]

    def format_help_text(self, ctx: Any, formatter: Any) -> None:
        """Write the description, of which ``-h`` shows the first paragraph, and the examples as they can be pasted."""
        paragraphs = plain(inspect.cleandoc(self.help or "").partition("\f")[0]).split("\n\n")
        examples = [" ".join(text.split()).removeprefix(EXAMPLE) for text in paragraphs if text.startswith(EXAMPLE)]
        description = [text for text in paragraphs if not text.startswith(EXAMPLE)]
        for text in description[:1] if self.brief else description:
            formatter.write_paragraph()
            with formatter.indentation():
                formatter.write_text(text)
        if examples:
            examples = examples[:1] if self.brief else examples
            with formatter.section("Example" if len(examples) == 1 else "Examples"):
                for example in examples:
                    formatter.write(f"{'':{formatter.current_indent}}{example}\n")

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the arguments, the required options, then each panel of options, in the order of the options."""
        params: list[Any] = [param for param in self.get_params(ctx) if not getattr(param, "hidden", False)]
        panels: dict[str, list[Any]] = {"Arguments": [], REQUIRED: []}
        for param in params:
            panels.setdefault(_panel(param), []).append(param)
        order = [*(name for name in panels if name not in LAST), *(name for name in LAST if name in panels)]
        if self.brief:
            self._write_brief(ctx, formatter, {name: panels[name] for name in order})
            return
        for name in filter(panels.get, order):
            with formatter.section(name):
                formatter.write_dl([_record(param, ctx) for param in panels[name]])

    def _write_brief(self, ctx: Any, formatter: Any, panels: Mapping[str, list[Any]]) -> None:
        """Write the arguments and required options, then the options that fit on one screen, the common ones first."""
        for name in filter(panels.get, ("Arguments", REQUIRED)):
            with formatter.section(name):
                formatter.write_dl([_brief_record(param, ctx) for param in panels[name]])
        optional = [param for name in panels if name not in ("Arguments", REQUIRED) for param in panels[name]]
        rows = [_brief_record(param, ctx) for param in optional]
        common = [number for name in COMMON for number, param in enumerate(optional) if param.name == name]
        shown_numbers: set[int] = set()
        for number in dict.fromkeys([*common, *range(len(optional))]):
            draft = type(formatter)(width=formatter.width, max_width=formatter.width)
            draft.write_dl([rows[index] for index in sorted({*shown_numbers, number})] if rows else [])
            if (formatter.getvalue() + draft.getvalue()).count("\n") > BRIEF_LINES - 4:
                break
            shown_numbers.add(number)
        with formatter.section(OPTIONS):
            formatter.write_dl([rows[number] for number in sorted(shown_numbers)])
        if hidden := len(optional) - len(shown_numbers):
            formatter.write(f"\n{hidden} more {'option' if hidden == 1 else 'options'}: {ctx.command_path} --help\n")


class BriefCommand(PanelCommand):
    """A command whose help is that of ``-h``."""

    brief = True


class HelpGroup(TyperGroup):
    """A group of commands whose help shows the complete summary of each."""

    def format_help_text(self, ctx: Any, formatter: Any) -> None:
        """Write the description."""
        formatter.write_paragraph()
        with formatter.indentation():
            for number, text in enumerate(plain(inspect.cleandoc(self.help or "")).split("\n\n")):
                formatter.write_paragraph() if number else None
                formatter.write_text(text)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write one line per command: its name and the first line of its help; in sections for the program itself."""
        rows = {}
        for name in self.list_commands(ctx):
            command = self.get_command(ctx, name)
            if command is not None and not command.hidden:
                rows[name] = (command.help or "").partition("\n")[0]
        width = max(map(len, rows), default=0)
        for title, names in (_sections(rows) if ctx.parent is None else {"Commands": tuple(rows)}).items():
            with formatter.section(title):
                formatter.write_dl([(name.ljust(width), rows[name]) for name in names])


def unrequested() -> None:
    """Represent a command that was not requested, in help alone."""


def _sections(rows: Mapping[str, str]) -> dict[str, tuple[str, ...]]:
    """Return the commands of ``rows`` by section; those that no section names are of other packages."""
    sections = {title: tuple(name for name in names if name in rows) for title, names in SECTIONS.items()}
    listed = {name for names in sections.values() for name in names}
    sections[PLUG_INS] = tuple(name for name in rows if name not in listed)
    return {title: names for title, names in sections.items() if names}


def plain(text: str) -> str:
    """Return a text without the backticks of its markup."""
    return re.sub(r"`+([^`\n]+)`+", r"\1", text)


def _panel(param: Any) -> str:
    """Return the panel in which a parameter is shown."""
    if param.param_type_name == "argument":
        return "Arguments"
    panel = getattr(param, "rich_help_panel", None)
    return str(panel or (REQUIRED if param.required else PANELS.get(str(param.name), OPTIONS)))


def _argument_name(param: Any) -> str:
    """Return the name of an argument in the usage line: in brackets where it can be left out."""
    name = str(param.metavar or param.name).upper() + ("..." if param.nargs == -1 else "")
    return name if param.required else f"[{name}]"


def _metavar(param: Any, ctx: Any) -> str:
    """Return the placeholder of an option's value: its choices, or its type."""
    if param.metavar:
        return str(param.metavar)
    placeholder = param.get_help_record(ctx)[0].split(" ", maxsplit=2 if len(param.opts) > 1 else 1)[-1]
    kind = re.sub(r"<(?:list\[)?([\w ]+)\]?>", r"\1", placeholder)
    return TYPES.get(kind.lower(), "TEXT") if kind != placeholder or kind.isupper() else kind


def _record(param: Any, ctx: Any) -> tuple[str, str]:
    """Return how a parameter is written, and its help with its default."""
    if param.param_type_name == "argument":
        return _argument_name(param).strip("[]"), f"{plain(param.help or '')}{'' if param.required else ' [optional]'}"
    names = ", ".join(sorted(param.opts, key=len))
    if param.secondary_opts:
        names += f" / {', '.join(param.secondary_opts)}"
    takes_value = not (param.is_flag or getattr(param, "count", False))
    text = _sentence(plain(param.help or ""))
    if takes_value and getattr(param, "multiple", False):
        text += " Can be repeated."
    default = param.default
    if takes_value and param.show_default and default not in (None, "", ()) and not callable(default):
        text += f" [default: {getattr(default, 'value', default)}]"
    return f"{names} {_metavar(param, ctx)}" if takes_value else names, text


def _sentence(text: str) -> str:
    """Return the help of an option as a sentence; the name of a choice at its start stays as it is typed.

    >>> _sentence("rate of the rows (Hz) [default: 50]"), _sentence("hold: newest sample"), _sentence("")
    ('Rate of the rows (Hz). [default: 50]', 'hold: newest sample.', '')
    """
    default = re.search(r" \[default: [^\]]+\]$", text)
    sentence = text[: default.start()] if default else text
    if sentence and not re.match(r"[\w-]+(?:, [\w-]+)*: ", sentence):
        sentence = sentence[0].upper() + sentence[1:]
    if sentence and not sentence.endswith("."):
        sentence += "."
    return sentence + (default[0] if default else "")


def _brief_record(param: Any, ctx: Any) -> tuple[str, str]:
    """Return the record of a parameter with the first clause of its help."""
    names, text = _record(param, ctx)
    default = re.search(r" \[default: [^\]]+\]$", text)
    clause = re.split(r"; |: |\. |\.$", text[: default.start()] if default else text)[0]
    if " " not in clause:  # The name of the first choice.
        clause = text.partition(";")[0]
    return names, clause + (default[0] if default else "")


def apply(program: typer.Typer, *, brief: bool) -> None:
    """Give every command and group of ``program`` this help, the one of ``-h`` where ``brief`` is true."""
    program.info.cls = HelpGroup
    for group in program.registered_groups:
        group.cls = HelpGroup
        if group.typer_instance is not None:
            apply(group.typer_instance, brief=brief)
    for command in program.registered_commands:
        command.cls = BriefCommand if brief else PanelCommand


def refuse_addresses(program: typer.Typer) -> None:
    """Have every command of ``program`` refuse addresses in all its arguments and options that are paths."""
    for group in program.registered_groups:
        if group.typer_instance is not None:
            refuse_addresses(group.typer_instance)
    for command in program.registered_commands:
        if command.callback is not None:
            command.callback = _checked(command.callback)


def _checked(callback: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(callback)
    def call(*args: Any, **options: Any) -> Any:
        for value in options.values():
            for path in value if isinstance(value, list | tuple) else [value]:
                if isinstance(path, Path):
                    local(path)
        return callback(*args, **options)

    return call
