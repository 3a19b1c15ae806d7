"""Add stages as commands, with arguments from the stage's signature and options from its params."""

from __future__ import annotations

import inspect
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import typer

from tacpipe import printable
from tacpipe.cli import stage_options
from tacpipe.cli.help import unrequested
from tacpipe.engine.request import OPTIONS, PATHS, Request
from tacpipe.errors import FAILED, TacpipeError, UsageError
from tacpipe.io import terminal
from tacpipe.plugins import failures, given_params, registry
from tacpipe.plugins import fields as fields_of
from tacpipe.plugins import params as params_of
from tacpipe.plugins.stage import AnyStage
from tacpipe.training import devices

if TYPE_CHECKING:
    from tacpipe.engine.outcome import Outcome


def add_group(program: typer.Typer, group: str, arguments: Sequence[str]) -> None:
    """Add the command ``group`` to ``program``: a stage, or a group with the stages that ``arguments`` name."""
    names = [name for name in registry.stages() if name.partition(".")[0] == group]
    if names == [group]:
        add(program, group, group, arguments)
        return
    group_help = registry.group_help(group) or registry.commands()[group]
    methods = typer.Typer(help=group_help, no_args_is_help=True, rich_markup_mode=None)
    by_method = {name.partition(".")[2]: name for name in names}
    requested = [method for method in by_method if method in arguments]
    for method in requested:  # A broken method must not affect the other methods.
        add(methods, by_method[method], method, arguments)
    for method in () if requested else by_method:
        methods.command(method, help=registry.summary(by_method[method]))(unrequested)
    program.add_typer(methods, name=group)


def add(program: typer.Typer, name: str, command: str, words: Sequence[str]) -> None:
    """Add stage ``name`` to ``program`` as ``command``, with options for its params; ``words`` are the command line's."""
    stage = registry.load(name)
    fields = params_of.fields(stage)
    parameters = stage_options.of(name, stage, fields, words)

    def call(**options: Any) -> None:
        _call(name, stage, options, [field for field in fields if options.get(field) is not None])

    call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    call.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    program.command(command, help=stage_options.summary(name, stage))(call)


def _call(name: str, stage: AnyStage, options: dict[str, Any], param_names: Sequence[str]) -> None:
    """Run a stage with the options of its command: print information, or compute one or several folds and report them.

    Raises `UsageError` for wrong options.
    """
    terminal.set_quiet(options["quiet"])
    for flag, kind in OPTIONS.items():
        if flag != "fold" and options.get(flag) is not None:  # Not all stages have all of these options.
            fields_of.check(options[flag], kind, f"--{flag}")
    if options.get("guess") and stage.source is not None and stage.source.guess is not None:
        with failures.naming_source([options["source"]]):
            layout = stage.source.guess(options["source"])
        terminal.result(layout.rstrip("\n"))
        return
    params = given_params.build(
        name,
        stage,
        file=_params_file(options),
        block=options["block"],
        preset=options["preset"],
        sets=options["set_"] or (),
        options={field: _parse_option(options[field], params_of.fields(stage)[field]) for field in param_names},
    )
    if options["print_params"]:
        terminal.result(json.dumps(params_of.to_input(params), indent=1))
        return
    if options.get("dry_run") and stage.source is not None and stage.source.preview is not None:
        with failures.naming_source([options["source"]]):
            description = stage.source.preview(params, options["source"])
        terminal.result(description)
        return
    if options["output"] is None:
        raise UsageError("Missing option -o. Give the directory to write, as -o data/output.")
    from tacpipe.engine import grid, pipeline  # These imports are not needed for help.

    requests = grid.requests(_request(name, stage, params, options), grid.parse_folds(options.get("fold") or "0"))
    # Checks and comparisons write nothing.
    headline_file = stage.headline if not (options["check"] or options["compare"]) else None
    report_options = {"as_json": options["json_"], "quiet": options["quiet"]}
    if len(requests) == 1:
        _report(pipeline.run(requests[0]), headline_file, **report_options)
    else:
        if stage.trains and not (options["quiet"] or options["check"] or options["compare"]):
            _print_estimate(requests)
        _run_folds(requests, headline_file, **report_options)


def _request(name: str, stage: AnyStage, params: Any, options: Mapping[str, Any]) -> Request:
    """Return the request that a command's options describe."""
    return Request(
        name,
        params,
        options["output"],
        datasets=options.get("datasets") or (),
        role=options.get("role"),
        jobs=options["jobs"],
        executor=options["executor"] or "",
        device=options.get("device") or devices.AUTO,
        skip_bad=options["skip_bad"],
        check=options["check"],
        compare=options["compare"],
        rerun=options["rerun"],
        replace=options["replace"],
        track=tuple(options.get("track") or ()),
    ).with_paths({key: options.get(key) for key in PATHS})


def _print_estimate(requests: Sequence[Request]) -> None:
    """Print the estimated training time of the missing models, if there is an estimate."""
    from tacpipe.engine import grid

    sentence = grid.estimate_duration(requests, requests[0].jobs)
    if sentence is not None:
        terminal.note(f"tacpipe: {sentence}")


def _run_folds(requests: Sequence[Request], headline: str | None, *, as_json: bool, quiet: bool) -> None:
    """Run a request for several folds and report each as it ends. Raises `TacpipeError` at the end if any fold failed."""
    from tacpipe.engine import by_recording, grid

    errors: list[TacpipeError] = []
    for request, result in grid.run(requests, requests[0].jobs):
        if isinstance(result, TacpipeError):
            errors.append(result)
            terminal.note(f"tacpipe: fold {request.fold}: {result}")
        else:
            _report(result, headline, as_json=as_json, quiet=quiet)
    if errors:
        message = f"{len(errors)} of {len(requests)} folds failed; the others are written."
        raise by_recording.error(max(error.exit_code for error in errors), message)


def _report(outcome: Outcome, headline: str | None, *, as_json: bool, quiet: bool) -> None:
    """Print an outcome: notes, left-out recordings, headlines, and the output's path or JSON. Exits if results differ."""
    for note in outcome.notes:
        terminal.note(f"tacpipe: {note}")
    for line in printable.grouped_failures(outcome.bad):
        terminal.note(f"tacpipe: left out {line}")
    if not quiet:
        terminal.note(f"{outcome.ran} ran, {outcome.reused} reused, {outcome.seconds:.1f} s")
    headlines_json = None
    if headline is not None and (as_json or not quiet):
        from tacpipe.cli import headline_table

        headlines = headline_table.of_output(outcome.output, headline)
        headlines_json = [entry.to_json() for entry in headlines or ()]
        if not quiet and headlines is not None:  # Tasks from other packages may have no headline.
            headline_table.show(headlines, outcome.output)
    if as_json:
        extra = {} if headlines_json is None else {"headline": headlines_json}
        terminal.result_json({"schema_version": 1, **outcome.to_json(), **extra})
    else:
        terminal.result(outcome.output)
    if outcome.differs:
        terminal.note(f"tacpipe: {outcome.describe_differences()}")
        raise typer.Exit(FAILED)


def _params_file(options: dict[str, Any]) -> Path | None:
    if options["params_file"] is not None:
        return Path(options["params_file"])
    default = Path("params.yaml")
    return default if options["block"] is not None or default.exists() else None


def _parse_option(value: Any, annotation: Any) -> Any:
    """Return an option's value, converted to its annotation if possible."""
    if isinstance(value, list):
        return [fields_of.parse_text(text, get_args(fields_of.bare(annotation))[0]) for text in value]
    return fields_of.parse_text(value, annotation) if isinstance(value, str) else value
