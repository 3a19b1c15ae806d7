"""The text of ``--help``: options in panels, summaries in full."""

from __future__ import annotations

from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

PARAMS, RUN, PRINTED = "Params", "Run", "Output"
PANELS = {  # of the options that commands share; a stage's params name theirs
    **dict.fromkeys(("preset", "params_file", "block", "set_", "print_params"), PARAMS),
    **dict.fromkeys(("split", "fold", "role", "codec", "init", "extend"), "Data"),
    **dict.fromkeys(("jobs", "executor", "skip_bad", "check", "compare", "rerun", "replace", "dry_run"), RUN),
    **dict.fromkeys(("output", "json_", "as_json", "quiet", "help"), PRINTED),
}
OPTIONS = "Options"
LAST = (PARAMS, RUN, PRINTED)  # panels that come after all others


class Command(TyperCommand):
    """A command whose help shows its options in panels: the one an option names, else that of `PANELS`."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the arguments, then each panel of options, in the order of the options."""
        panels: dict[str, list[tuple[str, str]]] = {}
        for param in self.get_params(ctx):
            record = param.get_help_record(ctx)
            if record is None:
                continue
            if param.param_type_name == "argument":
                panels.setdefault("Arguments", []).append(record)
                continue
            named = getattr(param, "rich_help_panel", None)
            panels.setdefault(named or PANELS.get(str(param.name), OPTIONS), []).append(record)
        order = [*(name for name in panels if name not in LAST), *(name for name in LAST if name in panels)]
        for name in order:
            with formatter.section(name):
                formatter.write_dl(panels[name])


class Group(TyperGroup):
    """A group of commands whose help shows the whole summary of each."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write one line a command: its name and the first line of its help."""
        rows = []
        for name in self.list_commands(ctx):
            command = self.get_command(ctx, name)
            if command is not None and not command.hidden:
                rows.append((name, (command.help or "").partition("\n")[0]))
        if rows:
            with formatter.section("Commands"):
                formatter.write_dl(rows)


def apply(program: typer.Typer) -> None:
    """Give every command and group of ``program`` this help."""
    program.info.cls = Group
    for group in program.registered_groups:
        group.cls = Group
        if group.typer_instance is not None:
            apply(group.typer_instance)
    for command in program.registered_commands:
        command.cls = Command
