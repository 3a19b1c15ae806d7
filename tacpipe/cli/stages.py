"""A stage as a command: arguments from its signature, options from its params."""

from __future__ import annotations

import contextlib
import inspect
import json
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import typer

from tacpipe import printable
from tacpipe.cli import stage_options
from tacpipe.engine.request import OPTIONS, PATHS, Request
from tacpipe.errors import FAILED, TacpipeError, UsageError
from tacpipe.io import progress, terminal
from tacpipe.plugins import fields as fields_of
from tacpipe.plugins import given_params, registry
from tacpipe.plugins import params as params_of
from tacpipe.plugins.stage import AnyStage
from tacpipe.training import devices

if TYPE_CHECKING:
    from tacpipe.engine.outcome import Outcome

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
    parameters = stage_options.of(stage, fields)

    def call(**given: Any) -> None:
        _call(name, stage, given, [field for field in fields if given.get(field) is not None])

    call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    call.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    program.command(command, help=stage_options.summary(name, stage))(call)


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
        raise UsageError("Missing option -o. Give the directory to write, as -o data/output.")
    from tacpipe.engine import grid, pipeline  # help needs neither

    requests = grid.requests(_request(name, stage, params, given), grid.folds(given.get("fold") or "0"))
    shown = stage.headline if not (given["check"] or given["compare"]) else None  # these write nothing
    how = {"as_json": given["json_"], "quiet": given["quiet"]}
    if answering:
        _report_answers(requests, shown, **how)
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
        device=given.get("device") or devices.AUTO,
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
    from tacpipe.engine import pipeline

    outcomes = [outcome for request in requests if (outcome := pipeline.answered(request)) is not None]
    if len(outcomes) < len(requests):
        raise UnansweredError
    for outcome in outcomes:
        _report(outcome, headline, as_json=as_json, quiet=quiet)


def _estimate(requests: Sequence[Request]) -> None:
    """Print how long the models that are missing take, as far as it can be known before."""
    from tacpipe.engine import estimate

    sentence = estimate.estimate_duration(requests, requests[0].jobs)
    if sentence is not None:
        terminal.note(f"tacpipe: {sentence}")


def _run_folds(requests: Sequence[Request], headline: str | None, *, as_json: bool, quiet: bool) -> None:
    """Run a request for several folds and report each as it ends. Raises `TacpipeError` at the end where some failed."""
    from tacpipe.engine import by_recording, grid

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
    for line in printable.grouped_failures(outcome.bad):
        terminal.note(f"tacpipe: left out {line}")
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


def _parsed(given: Any, wanted: Any) -> Any:
    """Return what was given for an option, as its annotation has it where that is possible."""
    if isinstance(given, list):
        return [fields_of.parsed(text, get_args(fields_of.bare(wanted))[0]) for text in given]
    return fields_of.parsed(given, wanted) if isinstance(given, str) else given
