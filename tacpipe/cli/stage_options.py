"""Build the arguments, options and help of a stage's command from the stage's signature and params."""

from __future__ import annotations

import inspect
import itertools
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import typer

from tacpipe.cli.help import REQUIRED
from tacpipe.io import terminal
from tacpipe.plugins import fields as fields_of
from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tacpipe.plugins.fields import Annotation
from tacpipe.plugins.requirements import Requirements
from tacpipe.plugins.stage import AnyStage
from tacpipe.training.devices import Device

PRINT_PARAMS = "--print-params"
EXAMPLE = "Example: "  # start of the last paragraph of a stage's docstring


def of(name: str, stage: AnyStage, fields: Mapping[str, Annotation], words: Sequence[str]) -> list[inspect.Parameter]:
    """Return the parameters of the command of stage ``name``; ``fields`` are the fields of its params by name.

    ``words`` are those of the command line. They determine which help is shown.
    """
    return [
        *_arguments(stage, words),
        *_shared_parameters(stage),
        *_options(stage, fields, words),
        *_looks(name, stage),
    ]


def _arguments(stage: AnyStage, words: Sequence[str]) -> list[inspect.Parameter]:
    """Return the positional arguments of a stage's command: source, model and datasets, as far as the stage reads them."""
    kinds = set(stage.arguments.values())
    default = None if PRINT_PARAMS in words else ...  # Printing params requires no data.
    arguments: list[tuple[str, Any, str]] = []
    if "Files" in kinds:
        arguments.append(("source", Path, "Folder of the recordings."))
    if stage.reads_model:
        arguments.append(("model", Path, "A trained model."))
    if kinds & {"Recording", "Dataset", "Datasets"}:
        arguments.append(("datasets", list[Path], "Datasets to read; several are read as one."))
    return [_parameter(name, kind, typer.Argument(default, help=text)) for name, kind, text in arguments]


def _shared_parameters(stage: AnyStage) -> list[inspect.Parameter]:
    """Return the options for the output and for the other datasets and services that a stage uses."""
    output = typer.Option(None, "-o", "--output", help="Directory to write.", rich_help_panel=REQUIRED)
    parameters = [_parameter("output", Path | None, output)]
    if stage.reads_split:
        parameters += [
            _parameter(
                "split",
                Path | None,
                typer.Option(
                    None,
                    "--split",
                    help="Split that assigns the roles train, val and test.",
                    rich_help_panel=REQUIRED if stage.needs_split else None,
                ),
            ),
            _parameter(
                "fold",
                str | None,
                typer.Option(
                    None, "--fold", help="Fold of the split; several as 0-4, with {fold} in paths such as -o."
                ),
            ),
        ]
    if stage.reads_model and not stage.needs_split:
        parameters.append(
            _parameter(
                "role", str | None, typer.Option(None, "--role", help="Role to read: train, val, calibration or test.")
            )
        )
    if stage.fit is not None:
        text = "A dataset whose fitted codec to apply."
        parameters.append(_parameter("codec", Path | None, typer.Option(None, "--codec", help=text)))
    if "init" in stage.arguments:
        text = "A model to begin with."
        parameters.append(_parameter("init", Path | None, typer.Option(None, "--init", help=text)))
    if stage.trains:
        text = "Device to train on; auto: cuda if there is one, else cpu."
        option = typer.Option(None, "--device", help=text, metavar=f"[{'|'.join(get_args(Device))}]")
        parameters.append(_parameter("device", str | None, option))
    if stage.tracked:
        text = f"Tracker of experiments, NAME or NAME:PLACE: {', '.join(registry.trackers())}."
        parameters.append(_parameter("track", list[str] | None, typer.Option(None, "--track", help=text)))
    if "extend" in stage.arguments:
        text = "An older split whose roles to keep."
        parameters.append(_parameter("extend", Path | None, typer.Option(None, "--extend", help=text)))
    return parameters


def _options(stage: AnyStage, fields: Mapping[str, Annotation], words: Sequence[str]) -> list[inspect.Parameter]:
    """Return an option for each param of a stage, and the options of params files, execution and printing."""
    helps = params_of.comments(stage) if {"--help", "-h"} & set(words) else {}
    panels = params_of.panels(stage)
    choice = _shown_choice(stage, words)
    parameters = []
    for name, hint in fields.items():
        kind = fields_of.bare(hint)
        is_sequence = get_origin(kind) is tuple
        flag = f"--{name.replace('_', '-')}"
        flags = [f"{flag}/--no-{name.replace('_', '-')}"] if kind is bool else [flag]
        # Option values are parsed like those of --set.
        annotation: Any = str | None
        if kind is bool:
            annotation = bool | None
        elif is_sequence:
            annotation = list[str] | None
        text = _about(stage, name, helps.get(name, ""))
        metavar = None if kind is bool else _metavar(hint)
        owners = params_of.choices_with(stage, name)
        option = typer.Option(
            None,
            *flags,
            help=text,
            show_default=False,
            metavar=metavar,
            rich_help_panel=panels.get(name),
            hidden=bool(owners) and choice not in owners,
        )
        parameters.append(_parameter(name, annotation, option))
    common_options: list[tuple[str, Any, Any]] = [
        (
            "preset",
            str | None,
            typer.Option(None, "--preset", help=f"Preset of params: {', '.join(params_of.presets(stage)) or 'none'}."),
        ),
        (
            "params_file",
            Path | None,
            typer.Option(None, "--params", help="File of params. Default: params.yaml if it exists."),
        ),
        ("block", str | None, typer.Option(None, "--block", help="Block of the params file, as forward.synchronize.")),
        ("set_", list[str] | None, typer.Option(None, "--set", help="Set a param: --set name=value.")),
        (
            "print_params",
            bool,
            typer.Option(False, PRINT_PARAMS, help="Print the params that would be used, and stop."),
        ),
        ("jobs", int, typer.Option(0, "--jobs", help="Processes to use; 0: one per core.")),
        (
            "executor",
            str | None,
            typer.Option(
                None, "--executor", help="Where to compute: local, dask, dask://localhost:PORT, tls://HOST:PORT, slurm."
            ),
        ),
        ("skip_bad", bool, typer.Option(False, "--skip-bad", help="Skip recordings that cannot be read.")),
        (
            "check",
            bool,
            typer.Option(False, "--check", help="Report what would change; exit with 3 if anything would."),
        ),
        (
            "compare",
            bool,
            typer.Option(
                False, "--recompute-and-compare", help="Compute stored results again and name the differences."
            ),
        ),
        (
            "rerun",
            bool,
            typer.Option(False, "--rerun", help="Compute even if a result is stored, and keep the new one."),
        ),
        (
            "replace",
            bool,
            typer.Option(False, "--replace", help="Replace other content of -o: a dataset, recordings, labels."),
        ),
        ("json_", bool, typer.Option(False, "--json", help="Print one JSON object.")),
        ("quiet", bool, typer.Option(False, "--quiet", help="No progress, no summary.")),
    ]
    return [*parameters, *(_parameter(*item) for item in common_options)]


def _looks(name: str, stage: AnyStage) -> list[inspect.Parameter]:
    """Return the options that print information instead of running the stage."""
    parameters = []
    if stage.source is not None and stage.source.guess is not None:
        text = "Print a first layout file for this folder, and stop."
        parameters.append(_parameter("guess", bool, typer.Option(False, "--guess", help=text)))
    if stage.source is not None and stage.source.preview is not None:
        text = "Describe the recordings, and stop."
        parameters.append(_parameter("dry_run", bool, typer.Option(False, "--dry-run", help=text)))
    if (requirements := registry.requirements(name)) is not None:
        text = "Print the required channels and labels, and stop."
        show = typer.Option(
            False, "--requirements", help=text, is_eager=True, callback=_requirements_callback(requirements)
        )
        parameters.append(_parameter("requirements", bool, show))
    return parameters


def _requirements_callback(requirements: Requirements) -> Callable[[bool], None]:
    """Return a callback that prints the requirements of a task before missing arguments are reported."""

    def show(requested: bool) -> None:
        if requested:
            terminal.result(requirements.to_text())
            raise typer.Exit

    return show


def _shown_choice(stage: AnyStage, words: Sequence[str]) -> str | None:
    """Return the architecture (or other kind of params) whose options the help shows; None if a stage has only one kind."""
    tag = params_of.tag(stage)
    if tag is None:
        return None
    for word, next_word in itertools.pairwise([*words, ""]):
        if word == f"--{tag}":
            return next_word
        if word.startswith(f"--{tag}="):
            return word.partition("=")[2]
    return str(params_of.defaults(stage, tag)[0])


def _about(stage: AnyStage, name: str, comment: str) -> str:
    """Return an option's help: its comment, its range, the choices that have it, and its default."""
    annotation = params_of.fields(stage)[name]
    parts = [comment] if comment else []
    if fields_of.constraints(annotation):
        parts.append(fields_of.describe(annotation))
    tag = params_of.tag(stage)
    if owners := params_of.choices_with(stage, name):
        parts.append(f"only with {tag} {', '.join(owners)}")
    if name == tag and any(params_of.choices_with(stage, field) for field in params_of.fields(stage)):
        parts.append(f"--{tag} NAME --help shows the options of NAME")
    defaults = [
        _format_default(name, value) for value in params_of.defaults(stage, name) if value not in (None, "", ())
    ]
    return "; ".join(parts) + (f" [default: {' or '.join(defaults)}]" if defaults else "")


def _format_default(name: str, value: Any) -> str:
    """Return a default in the syntax of the option."""
    if isinstance(value, bool):
        return ("" if value else "no-") + name.replace("_", "-")
    if isinstance(value, dict):
        return ",".join(f"{key}={item}" for key, item in value.items())
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _metavar(hint: Any) -> str:
    """Return the placeholder of an option's value, which is its choices or its type."""
    kind = fields_of.bare(hint)
    if get_origin(kind) is tuple:
        return f"{_metavar(get_args(kind)[0])}..."
    if get_origin(kind) is Literal:
        return f"[{'|'.join(map(str, get_args(kind)))}]"
    return {int: "INTEGER", float: "NUMBER"}.get(kind, "TEXT")


def _parameter(name: str, annotation: Any, default: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def summary(name: str, stage: AnyStage) -> str:
    """Return a stage's docstring: its module's if the module is named after the stage, else its function's.

    The last paragraph is an example, generated from the stage's arguments if the docstring has none.
    """
    module = stage.function.__module__
    module_doc, function_doc = sys.modules[module].__doc__, stage.function.__doc__
    docs = (module_doc, function_doc) if registry.is_named_after(module, name) else (function_doc, module_doc)
    text = inspect.cleandoc(docs[0] or docs[1] or "")
    return text if EXAMPLE in text else f"{text}\n\n{EXAMPLE}{example(name, stage)}"


def example(name: str, stage: AnyStage) -> str:
    """Return a sample command line, generated from the stage's arguments."""
    kinds = set(stage.arguments.values())
    words = ["tacpipe", *name.split(".")]
    words += ["published/recordings"] if "Files" in kinds else []
    words += ["models/model"] if stage.reads_model else []
    words += ["data/recordings"] if kinds & {"Recording", "Dataset"} else []
    words += ["results/one", "results/two"] if "Datasets" in kinds else []
    words += ["--split", "data/split"] if stage.needs_split or stage.reads_model else []
    output = "data/recordings" if kinds & {"Files", "Trial"} else f"data/{name.rpartition('.')[2]}"
    return " ".join([*words, "-o", output])
