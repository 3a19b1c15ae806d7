"""Format ``--help`` with option panels and ``-h`` on one screen, and reject URLs such as ``s3://`` as paths."""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from tacpipe.cli import guesses
from tacpipe.io.files import local

REQUIRED, PARAMS, RUN, OUTPUT, OPTIONS = "Required", "Params", "Run", "Output", "Options"
PANELS = {  # panels of options that several commands have; the params of a stage specify their own
    **dict.fromkeys(("preset", "params_file", "block", "set_", "print_params"), PARAMS),
    **dict.fromkeys(("split", "fold", "role", "codec", "init", "extend"), "Data"),
    **dict.fromkeys(("jobs", "executor", "skip_bad", "check", "compare", "rerun", "replace", "dry_run"), RUN),
    **dict.fromkeys(("output", "json_", "as_json", "quiet", "help"), OUTPUT),
}
LAST = (PARAMS, RUN, OUTPUT)  # panels shown after all others
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
# former names of options, which still work but are not shown in help
OLD_NAMES = {"--duration": "--duration-s", "--set": "--label", "--store": "--remote"}
EXAMPLE = "Example: "  # start of a paragraph with a command line, which is printed without line breaks
BRIEF_LINES = 40  # maximum number of lines that ``-h`` prints
TYPES = {
    "integer": "INTEGER",
    "int": "INTEGER",
    "float": "NUMBER",
    "path": "PATH",
    "file": "PATH",
}
SECTIONS = {  # commands in the order of ``tacpipe --help``; stages from other packages come last
    "Record": ("acquire", "live", "sensors"),
    "Import and export": ("ingest", "simulate", "export"),
    "Prepare": ("extract", "synchronize", "segment", "split", "compress", "label"),
    "Train and evaluate": ("train", "calibrate", "recentre", "evaluate", "predict", "compare", "report", "track"),
    "Look": ("show", "check", "view", "explain", "candidates"),
    "Manage": ("store", "demo", "try", "version"),
}
PLUG_INS = "Plug-ins"


class PanelCommand(TyperCommand):
    """Command whose help groups options in panels, which an option specifies or `PANELS` defines."""

    brief = False  # whether to show only common options

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse a command line as click does, and return the remaining arguments.

        An option name in `OLD_NAMES` is accepted if the command has no option of that name.
        """
        options = {name for param in self.params for name in (*param.opts, *param.secondary_opts)}
        renamed = {old: new for old, new in OLD_NAMES.items() if new in options and old not in options}
        end = args.index("--") if "--" in args else len(args)
        parts = [arg.partition("=") for arg in args[:end]]
        renamed_args = [renamed.get(name, name) + sign + value for name, sign, value in parts]
        return super().parse_args(ctx, renamed_args + args[end:])

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the usage after the command's name: arguments, required options, and a placeholder for other options."""
        params = self.get_params(ctx)
        arguments = [_argument_name(param) for param in params if param.param_type_name == "argument"]
        required = [
            f"{min(param.opts, key=len)} {_metavar(param, ctx)}"
            for param in params
            if param.param_type_name == "option" and _panel(param) == REQUIRED
        ]
        return [*arguments, *required, "[OPTIONS]"]

    def format_help_text(self, ctx: Any, formatter: Any) -> None:
        """Write the description, of which ``-h`` shows only the first paragraph, and examples that can be pasted."""
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
        """Write the arguments and required options, then each panel, with options in their original order."""
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
        """Write the arguments and required options, then as many options as fit on one screen, common ones first."""
        for name in filter(panels.get, ("Arguments", REQUIRED)):
            with formatter.section(name):
                formatter.write_dl([_brief_record(param, ctx) for param in panels[name]])
        optional = [param for name in panels if name not in ("Arguments", REQUIRED) for param in panels[name]]
        rows = [_brief_record(param, ctx) for param in optional]
        common = [index for name in COMMON for index, param in enumerate(optional) if param.name == name]
        selected: set[int] = set()  # indices of the options that fit
        for candidate in dict.fromkeys([*common, *range(len(optional))]):
            trial = type(formatter)(width=formatter.width, max_width=formatter.width)
            trial.write_dl([rows[index] for index in sorted({*selected, candidate})])
            if (formatter.getvalue() + trial.getvalue()).count("\n") > BRIEF_LINES - 4:
                break
            selected.add(candidate)
        with formatter.section(OPTIONS):
            formatter.write_dl([rows[index] for index in sorted(selected)])
        if hidden := len(optional) - len(selected):
            formatter.write(f"\n{hidden} more {'option' if hidden == 1 else 'options'}: {ctx.command_path} --help\n")


class BriefCommand(PanelCommand):
    """Command that prints the help of ``-h``."""

    brief = True


class HelpGroup(TyperGroup):
    """Group of commands whose help shows each command's complete summary."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return name, command and further words. The error for an unknown command states what may be meant."""
        try:
            return super().resolve_command(ctx, args)
        except misuse() as error:
            error.message = guesses.explain(ctx.command_path, args[0], self.list_commands(ctx), error.message)
            raise

    def format_help_text(self, ctx: Any, formatter: Any) -> None:
        """Write the description, one paragraph after another."""
        formatter.write_paragraph()
        with formatter.indentation():
            for number, text in enumerate(plain(inspect.cleandoc(self.help or "")).split("\n\n")):
                formatter.write_paragraph() if number else None
                formatter.write_text(text)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write each command's name and the first line of its help, grouped in sections for the main program."""
        rows = {}
        for name in self.list_commands(ctx):
            command = self.get_command(ctx, name)
            if command is not None and not command.hidden:
                rows[name] = (command.help or "").partition("\n")[0]
        width = max(map(len, rows), default=0)
        for title, names in (_sections(rows) if ctx.parent is None else {"Commands": tuple(rows)}).items():
            with formatter.section(title):
                formatter.write_dl([(name.ljust(width), rows[name]) for name in names])


def misuse() -> type[Any]:
    """Return the exception type that click raises for a malformed command line; typer may bundle its own click."""
    return next(kind for kind in typer.BadParameter.__mro__ if kind.__name__ == "ClickException")


def unrequested() -> None:
    """Serve as a placeholder in help for commands that were not requested."""


def _sections(rows: Mapping[str, str]) -> dict[str, tuple[str, ...]]:
    """Return the commands of ``rows`` by section; commands outside all sections come from other packages."""
    sections = {title: tuple(name for name in names if name in rows) for title, names in SECTIONS.items()}
    listed = {name for names in sections.values() for name in names}
    sections[PLUG_INS] = tuple(name for name in rows if name not in listed)
    return {title: names for title, names in sections.items() if names}


def plain(text: str) -> str:
    """Return a text without backticks."""
    return re.sub(r"`+([^`\n]+)`+", r"\1", text)


def _panel(param: Any) -> str:
    """Return the panel in which a parameter is shown."""
    if param.param_type_name == "argument":
        return "Arguments"
    panel = getattr(param, "rich_help_panel", None)
    return str(panel or (REQUIRED if param.required else PANELS.get(str(param.name), OPTIONS)))


def _argument_name(param: Any) -> str:
    """Return an argument's name in the usage line, in brackets if it is optional."""
    name = str(param.metavar or param.name).upper() + ("..." if param.nargs == -1 else "")
    return name if param.required else f"[{name}]"


def _metavar(param: Any, ctx: Any) -> str:
    """Return the placeholder of an option's value: its own, its choices, or its type."""
    if param.metavar:
        return str(param.metavar)
    placeholder = param.get_help_record(ctx)[0].split(" ", maxsplit=2 if len(param.opts) > 1 else 1)[-1]
    if param.nargs > 1:
        return " ".join(["NUMBER"] * param.nargs)
    placeholder = placeholder.replace(" range>", ">")
    kind = re.sub(r"<(?:list\[)?([\w ]+)\]?>", r"\1", placeholder)
    return TYPES.get(kind.lower(), "TEXT") if kind != placeholder or kind.isupper() else kind


def _record(param: Any, ctx: Any) -> tuple[str, str]:
    """Return a parameter's syntax, and its help text with the default."""
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
        value = " ".join(map(str, default)) if isinstance(default, tuple) else getattr(default, "value", default)
        text += f" [default: {value}]"
    return f"{names} {_metavar(param, ctx)}" if takes_value else names, text


def _sentence(text: str) -> str:
    """Return an option's help as a sentence, without capitalizing a choice at its start.

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
    """Return the syntax and help of a parameter as `_record` does, with only the first clause of the help."""
    names, text = _record(param, ctx)
    default = re.search(r" \[default: [^\]]+\]$", text)
    described = text[: default.start()] if default else text
    clause = re.split(r"; |: |\. |\.$", described)[0]
    if " " not in clause:  # the name of the first choice, as in "auto: as many as ..."; its description is needed too
        clause = described.partition(";")[0]
    return names, clause + (default[0] if default else "")


def apply(program: typer.Typer, *, brief: bool) -> None:
    """Set the help format of every command and group of ``program``, that of ``-h`` if ``brief`` is true."""
    program.info.cls = HelpGroup
    for group in program.registered_groups:
        group.cls = HelpGroup
        if group.typer_instance is not None:
            apply(group.typer_instance, brief=brief)
    for command in program.registered_commands:
        command.cls = BriefCommand if brief else PanelCommand


def refuse_addresses(program: typer.Typer) -> None:
    """Make every command of ``program`` reject URLs in arguments and options that are paths."""
    for group in program.registered_groups:
        if group.typer_instance is not None:
            refuse_addresses(group.typer_instance)
    for command in program.registered_commands:
        if command.callback is not None:
            command.callback = _refusing_addresses(command.callback)


def _refusing_addresses(callback: Callable[..., Any]) -> Callable[..., Any]:
    """Return the callback of a command such that it refuses URLs as paths.

    Raises `UsageError` when it is called with one.
    """

    @functools.wraps(callback)
    def call(*args: Any, **options: Any) -> Any:
        for value in options.values():
            for path in value if isinstance(value, list | tuple) else [value]:
                if isinstance(path, Path):
                    local(path)
        return callback(*args, **options)

    return call
