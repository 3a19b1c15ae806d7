"""A stage as a command: arguments from its signature, options from its params."""

from __future__ import annotations

import contextlib
import inspect
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import typer

from tacpipe.engine import by_recording, estimate, grid, pipeline, rank_processes
from tacpipe.engine.outcome import Outcome
from tacpipe.engine.request import OPTIONS, PATHS, Request
from tacpipe.errors import FAILED, TacpipeError, UsageError
from tacpipe.io import progress, terminal
from tacpipe.plugins import fields as fields_of
from tacpipe.plugins import given_params, registry
from tacpipe.plugins import params as params_of
from tacpipe.plugins.requirements import Requirements
from tacpipe.plugins.stage import AnyStage
from tacpipe.training.devices import AUTO, Compute, Device

EXAMPLE = "Example: "  # begins the last paragraph of a stage's docstring


_answering: ContextVar[bool] = ContextVar("answering", default=False)


class UnansweredError(Exception):
    """A command has something to compute or to write, or is one that always does something."""


@contextlib.contextmanager
def answering() -> Iterator[None]:
    """Have the commands of stages in the block report what is there already, and raise `UnansweredError` where it is not."""
    token = _answering.set(True)
    try:
        yield
    finally:
        _answering.reset(token)


def add_group(program: typer.Typer, group: str, arguments: Sequence[str]) -> None:
    """Add the command ``group`` to ``program``: a stage, or those whose names begin so, of which ``arguments`` name one."""
    names = [name for name in registry.stages() if name.partition(".")[0] == group]
    if names == [group]:
        add(program, group, group)
        return
    methods = typer.Typer(help=registry.commands()[group], no_args_is_help=True, rich_markup_mode=None)
    by_method = {name.partition(".")[2]: name for name in names}
    asked = [method for method in by_method if method in arguments]
    for method in asked:  # and no other: a broken method spoils itself alone
        add(methods, by_method[method], method)
    for method in () if asked else by_method:
        methods.command(method, help=registry.summary(by_method[method]))(nothing)
    program.add_typer(methods, name=group)


def nothing() -> None:
    """Represent a command that was not requested."""


def add(program: typer.Typer, name: str, command: str) -> None:
    """Add stage ``name`` to ``program`` as ``command``."""
    stage = registry.load(name)
    fields = params_of.fields(stage)
    parameters = [*_arguments(stage), *_shared(stage), *_options(stage, fields), *_looks(stage)]

    def call(**given: Any) -> None:
        _call(name, stage, given, [field for field in fields if given.get(field) is not None])

    call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    call.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    program.command(command, help=_help(name, stage))(call)


def _call(name: str, stage: AnyStage, given: dict[str, Any], named: Sequence[str]) -> None:
    answering = _answering.get()
    if answering and any(given.get(look) for look in ("guess", "print_params", "dry_run")):
        raise UnansweredError
    progress.set_quiet(given["quiet"])
    for flag, kind in OPTIONS.items():
        if flag != "fold" and given.get(flag) is not None:  # not every stage has each of them
            fields_of.check(given[flag], kind, f"--{flag}")
    if given.get("guess") and stage.guess is not None:
        terminal.result(stage.guess(given["source"]).rstrip("\n"))
        return
    params = given_params.build(
        name,
        stage,
        file=_params_file(given),
        block=given["block"],
        preset=given["preset"],
        sets=given["set_"] or (),
        options={field: _parsed(given[field], params_of.fields(stage)[field]) for field in named},
    )
    if given["print_params"]:
        terminal.result(json.dumps(params_of.to_input(params), indent=1))
        return
    if given.get("dry_run") and stage.preview is not None:
        terminal.result(stage.preview(params, given["source"]))
        return
    if given["output"] is None:
        raise typer.BadParameter("give the directory to write with -o", param_hint="-o")
    requests = grid.requests(_request(name, stage, params, given), grid.folds(given.get("fold") or "0"))
    shown = stage.headline if not (given["check"] or given["compare"]) else None  # these write nothing
    how = {"as_json": given["json_"], "quiet": given["quiet"]}
    if answering:
        _report_answers(requests, shown, **how)
    elif stage.trains and rank_processes.launched():
        _run_launched(requests, shown, **how)
    elif len(requests) == 1:
        _report(pipeline.run(requests[0]), shown, **how)
    else:
        if stage.trains and not (given["quiet"] or given["check"] or given["compare"]):
            _estimate(requests)
        _run_folds(requests, shown, **how)


def _request(name: str, stage: AnyStage, params: Any, given: Mapping[str, Any]) -> Request:
    """Return what the options of a command request."""
    paths: dict[str, Any] = {key: given.get(key) for key in PATHS}
    return Request(
        name,
        params,
        given["output"],
        datasets=given.get("datasets") or (),
        role=given.get("role"),
        jobs=given["jobs"],
        executor=given["executor"] or "",
        compute=Compute(given.get("device") or AUTO, rank_processes.asked(given.get("devices")) if stage.trains else 1),
        skip_bad=given["skip_bad"],
        check=given["check"],
        compare=given["compare"],
        rerun=given["rerun"],
        replace=given["replace"],
        track=tuple(given.get("track") or ()),
        **paths,
    )


def _report_answers(requests: Sequence[Request], headline: str | None, *, as_json: bool, quiet: bool) -> None:
    """Report what is there already. Raises `UnansweredError` where some is not."""
    outcomes = [outcome for one in requests if (outcome := pipeline.answered(one)) is not None]
    if len(outcomes) < len(requests):
        raise UnansweredError
    for outcome in outcomes:
        _report(outcome, headline, as_json=as_json, quiet=quiet)


def _estimate(requests: Sequence[Request]) -> None:
    """Print how long the models that are missing take, as far as it can be known before."""
    found = estimate.of(requests, requests[0].jobs)
    if found is not None:
        terminal.note(f"tacpipe: {found}")


def _run_launched(requests: Sequence[Request], headline: str | None, *, as_json: bool, quiet: bool) -> None:
    """Run a request as one of the processes of ``torchrun``: the first one does, and others train along."""
    if len(requests) > 1:
        raise UsageError(f"torchrun has started processes to train one network together, not {len(requests)} folds.")
    if rank_processes.first():
        with rank_processes.leading():
            _report(pipeline.run(requests[0]), headline, as_json=as_json, quiet=quiet)
    else:
        from tacpipe.engine import rank

        rank.follow()


def _run_folds(requests: Sequence[Request], headline: str | None, *, as_json: bool, quiet: bool) -> None:
    """Run a request for several folds and report each as it ends. Raises `TacpipeError` at the end where some failed."""
    failed: list[TacpipeError] = []
    for one, became in grid.run(requests, requests[0].jobs):
        if isinstance(became, TacpipeError):
            failed.append(became)
            terminal.note(f"tacpipe: fold {one.fold}: {became}")
        else:
            _report(became, headline, as_json=as_json, quiet=quiet)
    if failed:
        what = f"{len(failed)} of {len(requests)} folds failed; the others are written."
        raise by_recording.error(max(one.exit_code for one in failed), what)


def _report(outcome: Outcome, headline: str | None, *, as_json: bool, quiet: bool) -> None:
    for note in outcome.notes:
        terminal.note(f"tacpipe: {note}")
    for name, why in outcome.bad.items():
        terminal.note(f"tacpipe: left out {name}: {why}")
    if not quiet:
        terminal.note(f"{outcome.ran} ran, {outcome.reused} reused, {outcome.seconds:.1f} s")
    extra: dict[str, Any] = {}
    if headline is not None and (as_json or not quiet):
        from tacpipe.cli import headline_table

        found = headline_table.of_output(outcome.output, headline)
        extra["headline"] = [one.to_json() for one in found or ()]
        if not quiet and found is not None:  # a task of another package may state none
            headline_table.show(found)
    if as_json:
        terminal.result_json({"schema_version": 1, **outcome.to_json(), **extra})
    else:
        terminal.result(outcome.output)
    if outcome.differs:
        terminal.note(f"tacpipe: {outcome.describe_differences()}")
        raise typer.Exit(FAILED)


def _params_file(given: dict[str, Any]) -> Path | None:
    if given["params_file"] is not None:
        return Path(given["params_file"])
    default = Path("params.yaml")
    return default if given["block"] is not None or default.exists() else None


def _arguments(stage: AnyStage) -> list[inspect.Parameter]:
    kinds = set(stage.arguments.values())
    found = []
    if "Files" in kinds:
        found.append(_parameter("source", Path, typer.Argument(help="Folder of the recordings.")))
    if stage.reads_model:
        found.append(_parameter("model", Path, typer.Argument(help="A trained model.")))
    if kinds & {"Recording", "Dataset", "Datasets"}:
        found.append(
            _parameter("datasets", list[Path], typer.Argument(help="Datasets to read; several are read as one."))
        )
    return found


def _shared(stage: AnyStage) -> list[inspect.Parameter]:
    kinds = set(stage.arguments.values())
    found = [_parameter("output", Path | None, typer.Option(None, "-o", "--output", help="Where to write."))]
    if stage.needs_split or stage.reads_model:
        found += [
            _parameter(
                "split", Path | None, typer.Option(None, "--split", help="Which recordings train, validate, test.")
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
        found.append(
            _parameter("role", str | None, typer.Option(None, "--role", help="Role to read: train, val or test."))
        )
    if stage.fit is not None:
        text = "A dataset whose fitted codec to apply."
        found.append(_parameter("codec", Path | None, typer.Option(None, "--codec", help=text)))
    if "init" in stage.arguments:
        text = "A model to begin with."
        found.append(_parameter("init", Path | None, typer.Option(None, "--init", help=text)))
    if stage.trains:
        text = "What to train on; auto: cuda where there is one, else cpu."
        option = typer.Option(None, "--device", help=text, metavar=f"[{'|'.join(get_args(Device))}]")
        found.append(_parameter("device", str | None, option))
        text = "Devices that train one network together, each in a process [1]."
        found.append(_parameter("devices", int | None, typer.Option(None, "--devices", help=text)))
    if stage.tracked:
        text = f"Tracker of experiments, NAME or NAME:PLACE: {', '.join(registry.trackers())}."
        found.append(_parameter("track", list[str] | None, typer.Option(None, "--track", help=text)))
    if "Roles" in kinds:
        text = "An older split whose roles to keep."
        found.append(_parameter("extend", Path | None, typer.Option(None, "--extend", help=text)))
    return found


def _options(stage: AnyStage, fields: dict[str, Any]) -> list[inspect.Parameter]:
    helps = params_of.comments(stage) if {"--help", "-h"} & set(sys.argv) else {}
    panels = params_of.panels(stage)
    found = []
    for name, wanted in fields.items():
        kind = fields_of.bare(wanted)
        many = get_origin(kind) is tuple
        flag = f"--{name.replace('_', '-')}"
        flags = [f"{flag}/--no-{name.replace('_', '-')}"] if kind is bool else [flag]
        annotation = bool | None if kind is bool else list[str] | None if many else str | None  # parsed as --set is
        text = _about(stage, name, helps.get(name, ""))
        metavar = None if kind is bool else _metavar(wanted)
        option = typer.Option(
            None, *flags, help=text, show_default=False, metavar=metavar, rich_help_panel=panels.get(name)
        )
        found.append(_parameter(name, annotation, option))
    more: list[tuple[str, Any, Any]] = [
        (
            "preset",
            str | None,
            typer.Option(None, "--preset", help=f"Preset of params: {', '.join(params_of.presets(stage)) or 'none'}."),
        ),
        (
            "params_file",
            Path | None,
            typer.Option(None, "--params", help="File of params [params.yaml if there is one]."),
        ),
        ("block", str | None, typer.Option(None, "--block", help="Block of the params file, as forward.synchronize.")),
        ("set_", list[str] | None, typer.Option(None, "--set", help="Set a param: --set name=value.")),
        (
            "print_params",
            bool,
            typer.Option(False, "--print-params", help="Print the params that would count, and stop."),
        ),
        ("jobs", int, typer.Option(0, "--jobs", help="Processes to use; 0: one a core.")),
        (
            "executor",
            str | None,
            typer.Option(
                None, "--executor", help="Where to compute: local, dask, dask://localhost:PORT, tls://HOST:PORT, slurm."
            ),
        ),
        ("skip_bad", bool, typer.Option(False, "--skip-bad", help="Skip recordings that cannot be read.")),
        ("check", bool, typer.Option(False, "--check", help="Do nothing; exit with 3 if something would change.")),
        (
            "compare",
            bool,
            typer.Option(False, "--recompute-and-compare", help="Run again what is stored and name what differs."),
        ),
        ("rerun", bool, typer.Option(False, "--rerun", help="Compute what is stored too, and keep the new result.")),
        (
            "replace",
            bool,
            typer.Option(False, "--replace", help="Replace what -o holds: another dataset, recordings, labels."),
        ),
        ("json_", bool, typer.Option(False, "--json", help="Print one JSON object.")),
        ("quiet", bool, typer.Option(False, "--quiet", help="No progress, no summary.")),
    ]
    return [*found, *(_parameter(*item) for item in more)]


def _looks(stage: AnyStage) -> list[inspect.Parameter]:
    """Return the options that print something of a source and write nothing."""
    found = []
    if stage.guess is not None:
        text = "Print a first layout file for this folder, and stop."
        found.append(_parameter("guess", bool, typer.Option(False, "--guess", help=text)))
    if stage.preview is not None:
        text = "Describe what would be read, and stop."
        found.append(_parameter("dry_run", bool, typer.Option(False, "--dry-run", help=text)))
    if stage.requirements is not None:
        text = "Print what recordings must hold, and stop."
        show = typer.Option(False, "--requirements", help=text, is_eager=True, callback=_shows(stage.requirements))
        found.append(_parameter("requirements", bool, show))
    return found


def _shows(requirements: Requirements) -> Callable[[bool], None]:
    """Return what prints the requirements of a task, before the arguments of its command are missed."""

    def show(given: bool) -> None:
        if given:
            terminal.result(requirements.to_text())
            raise typer.Exit

    return show


def _parsed(given: Any, wanted: Any) -> Any:
    """Return what was given for an option, as its annotation has it where that is possible."""
    if isinstance(given, list):
        return [fields_of.parsed(text, get_args(fields_of.bare(wanted))[0]) for text in given]
    return fields_of.parsed(given, wanted) if isinstance(given, str) else given


def _about(stage: AnyStage, name: str, comment: str) -> str:
    """Return the help of an option: its comment, what it may be, which choices have it, and its default."""
    wanted = params_of.fields(stage)[name]
    parts = [comment] if comment else []
    if fields_of.constraints(wanted):
        parts.append(fields_of.describe(wanted))
    if owners := params_of.having(stage, name):
        parts.append(f"only with {params_of.tag(stage)} {', '.join(owners)}")
    return f"{'; '.join(parts)} [{' or '.join(map(str, params_of.defaults(stage, name)))}]".strip()


def _metavar(wanted: Any) -> str:
    """Return what represents an option's value in its help: the choices, or the type."""
    kind = fields_of.bare(wanted)
    if get_origin(kind) is tuple:
        return f"{_metavar(get_args(kind)[0])}..."
    if get_origin(kind) is Literal:
        return f"[{'|'.join(map(str, get_args(kind)))}]"
    return {int: "INTEGER", float: "NUMBER"}.get(kind, "TEXT")


def _parameter(name: str, annotation: Any, default: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _help(name: str, stage: AnyStage) -> str:
    """Return the docstring of a stage: that of its module where the command is the stage alone, else of its function.

    Its last paragraph is an example; one is made of the stage's arguments where it has none.
    """
    own, module = stage.function.__doc__, sys.modules[stage.function.__module__].__doc__
    text = inspect.cleandoc((own or module if "." in name else module or own) or "")
    return text if EXAMPLE in text else f"{text}\n\n{EXAMPLE}{example(name, stage)}"


def example(name: str, stage: AnyStage) -> str:
    """Return a command line that shows the stage at work, as its arguments allow."""
    kinds = set(stage.arguments.values())
    words = ["tacpipe", *name.split(".")]
    words += ["published/recordings"] if "Files" in kinds else []
    words += ["models/model"] if stage.reads_model else []
    words += ["data/recordings"] if kinds & {"Recording", "Dataset"} else []
    words += ["results/one", "results/two"] if "Datasets" in kinds else []
    words += ["--split", "data/split"] if stage.needs_split or stage.reads_model else []
    output = "data/recordings" if kinds & {"Files", "Trial"} else f"data/{name.rpartition('.')[2]}"
    return " ".join([*words, "-o", output])
