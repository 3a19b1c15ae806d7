"""Add the commands that are not stages, which manage datasets and the store."""

from __future__ import annotations

import contextlib
import importlib
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from tacpipe.errors import UsageError
from tacpipe.io import terminal
from tacpipe.plugins import registry
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import excerpt, listed, plain

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Opens = Annotated[bool, typer.Option("--open", help="Open the report in a browser.")]
Datasets = Annotated[list[Path], typer.Argument(help="Datasets.")]
SUMMARIES = {
    "live": "Predict while a rig is recorded.",
    "label": "Change the labels of recordings, or exclude recordings.",
    "show": "Show the content of a dataset, split, model or result.",
    "check": "Find faults in recordings: time, channels, labels, copies.",
    "compare": "Compare results: the best first, columns for what differs.",
    "track": "Send models and results to trackers of experiments.",
    "view": "Show recordings on one time axis, in Rerun's viewer.",
    "explain": "Show the origin of a dataset and what changed.",
    "sensors": "List, probe and emulate sensors.",
    "store": "Manage the store: verify, repair, push, pull.",
    "candidates": "List grasps on an object, with the predicted touch of each.",
    "demo": "Run a whole pipeline on simulated recordings.",
    "try": "Run a whole pipeline on your own files, with guesses.",
    "version": "Show the versions of tacpipe, Python and libraries.",
}


def _add_label(program: typer.Typer) -> None:
    """Add the command ``label``, which sets labels or intervals from options or from a table."""

    @program.command(
        "label",
        help=SUMMARIES["label"]
        + "\n\nSets labels on the named recordings, or those of a table with one row per recording (--from, as CSV, TSV, "
        "Parquet, JSON or YAML). An empty cell changes nothing.\n\nIntervals such as slips are in seconds since the "
        "first sample of a recording. --interval adds one to those of the named recordings. --intervals replaces those "
        "of the recordings in a CSV with the columns recording, interval, from_s and to_s; a row without times states "
        "that there is none.\n\nExample: tacpipe label data/recordings trial-003 --label material=foam\n\nExample: "
        "tacpipe label data/recordings trial-003 --interval slip 1.2 1.5",
    )
    def label(
        dataset: Annotated[Path, typer.Argument(help="The recordings.")],
        names: Annotated[
            list[str] | None, typer.Argument(help="Names of recordings; * and ? match any letters.")
        ] = None,
        label: Annotated[
            list[str] | None, typer.Option("--label", help="Label as name=value; null removes it.")
        ] = None,
        exclude: Annotated[
            str | None, typer.Option("--exclude", help="Exclude from all stages, for this reason.")
        ] = None,
        include: Annotated[bool, typer.Option("--include", help="Undo --exclude.")] = False,
        interval: Annotated[
            tuple[str, float, float] | None,
            typer.Option("--interval", help="Interval to add: its name, start and end, s.", metavar="NAME FROM TO"),
        ] = None,
        intervals: Annotated[Path | None, typer.Option("--intervals", help="CSV with one row per interval.")] = None,
        from_: Annotated[
            Path | None, typer.Option("--from", help="Table with one row per recording and one column per label.")
        ] = None,
        key: Annotated[
            str, typer.Option("--key", help="Column of --from with the names of recordings; detected if omitted.")
        ] = "",
        dry_run: Annotated[
            bool, typer.Option("--dry-run", help="Print the labels that --from would change, and stop.")
        ] = False,
        as_json: AsJson = False,
    ) -> None:
        from tacpipe.datasets import labels

        if intervals is not None:
            refuse_others(names, label, exclude, include, from_, interval, option="--intervals")
            label_intervals(dataset, intervals, as_json=as_json)
            return
        if from_ is not None:
            refuse_others(names, label, exclude, include, interval)
            label_from_table(dataset, from_, key, dry_run=dry_run, as_json=as_json)
            return
        check_labels_without_table(names, key, dry_run)
        assert names is not None
        parsed_labels = {} if interval and not label else labels.parse(label or [], exclude, include=include)
        changed = labels.change(dataset, names, parsed_labels, interval)
        value = {
            "schema_version": 1,
            "output": str(changed.directory),
            "recordings": changed.recordings,
            "labels": parsed_labels,
        }
        note_labels(changed.directory)
        terminal.result_json(value) if as_json else terminal.result(changed.directory)


def _add_show(program: typer.Typer) -> None:
    """Add the command ``show``, which prints an overview of a dataset or a recording, or draws a recording."""

    @program.command(
        "show",
        help=SUMMARIES["show"]
        + "\n\nExample: tacpipe show data/recordings"
        + "\n\nExample: tacpipe show data/recordings trial-003"
        + "\n\nExample: tacpipe show data/recordings trial-003 --plot trial-003.png",
    )
    def show(
        dataset: Annotated[Path, typer.Argument(help="A dataset.")],
        recording: Annotated[str | None, typer.Argument(help="A recording of it.")] = None,
        plot: Annotated[
            Path | None, typer.Option("--plot", help="Draw one recording over time: .png, .svg or .pdf.")
        ] = None,
        as_json: AsJson = False,
        full: Annotated[
            bool, typer.Option("--full", help="All recordings, columns, labels and files, not the first ones.")
        ] = False,
    ) -> None:
        from tacpipe.cli import show as overview
        from tacpipe.cli import show_recording

        if plot is not None:
            terminal.result(show_recording.draw(dataset, recording, plot))
            return
        if recording is not None:
            value: overview.Shown = show_recording.overview(dataset, recording)
        else:
            value = overview.of(dataset, most=None if full or as_json else overview.SHOWN)
        _print(value, overview.to_text, as_json=as_json, full=full)


def _add_compare(program: typer.Typer) -> None:
    """Add the command ``compare``, which prints results next to each other as tables, CSV or JSON."""

    @program.command(
        "compare",
        help=SUMMARIES["compare"]
        + "\n\nPrints errors, and the gain over the best baseline with its interval. Runs that differ only in seed or fold "
        "are pooled.\n\nExample: tacpipe compare results/forward results/forward-gru",
    )
    def compare(
        results: Annotated[list[Path], typer.Argument(help="Results of `tacpipe evaluate`.")],
        unpooled: Annotated[
            bool, typer.Option("--each", help="Print one row per result, without pooling folds and seeds.")
        ] = False,
        as_csv: Annotated[bool, typer.Option("--csv", help="Print CSV.")] = False,
        as_json: AsJson = False,
    ) -> None:
        from tacpipe.cli import compare as comparing

        if as_csv and as_json:
            raise UsageError("--csv and --json exclude each other. Give only one of them.")
        comparison = comparing.run(results, pool=not unpooled)
        with _ends_with_its_reader():
            if as_json:
                terminal.result_json(comparison.to_json())
            elif as_csv:
                terminal.result(comparison.to_csv())
            else:
                for number, (sentences, table) in enumerate(comparison.tables()):
                    terminal.result("\n".join(["", *sentences] if number else sentences))
                    terminal.show(table, on_stdout=True)


def _add_track(program: typer.Typer) -> None:
    """Add the command ``track``, which sends stored models and results to experiment trackers."""

    @program.command(
        "track",
        help=SUMMARIES["track"]
        + "\n\nSends the params, epochs and metrics of each. A model that was trained with --track updates its "
        "run.\n\nExample: tacpipe track models/forward results/forward --to tensorboard",
    )
    def track(
        datasets: Annotated[list[Path], typer.Argument(help="Models and results.")],
        to: Annotated[list[str], typer.Option("--to", help="Tracker, NAME or NAME:PLACE: tensorboard, mlflow, wandb.")],
    ) -> None:
        from tacpipe.trackers import tracking

        for name in tracking.track_stored(datasets, to):
            terminal.result(name)


def _add_explain(program: typer.Typer) -> None:
    """Add the command ``explain``, which prints how a dataset was made."""

    @program.command("explain", help=SUMMARIES["explain"] + "\n\nExample: tacpipe explain results/forward")
    def explain(dataset: Annotated[Path, typer.Argument(help="A dataset or report.")], as_json: AsJson = False) -> None:
        from tacpipe.datasets import lineage

        _print(lineage.trace(dataset), lineage.to_text, as_json=as_json)


def _add_demo(program: typer.Typer) -> None:
    """Add the command ``demo``, which runs a chain of commands on simulated recordings or an emulated rig."""

    @program.command("demo", help=SUMMARIES["demo"] + "\n\nExample: tacpipe demo -o demo")
    def demo(
        output: Annotated[Path, typer.Option("-o", "--output", help="Directory to write.")] = Path("demo"),
        rig: Annotated[
            Path | None,
            typer.Option("--rig", help="Rig file: replay simulated trials as this rig, and record them."),
        ] = None,
        opens: Opens = False,
    ) -> None:
        from tacpipe.cli import demo as demonstration

        _show_page(demonstration.run(output) if rig is None else demonstration.run_rig(output, rig), opens=opens)


def _add_try(program: typer.Typer) -> None:
    """Add the command ``try``, which guesses how to read a folder, and runs a chain of commands on it."""

    @program.command(
        "try",
        help=SUMMARIES["try"]
        + "\n\nGuesses how to read the files, reads and checks them, puts the streams on one time axis, learns a label or a "
        "force, and writes a report. Each step is a command that is printed, and the guesses are the file "
        "OUTPUT/layout.toml: change them, and run the command again.\n\nExample: tacpipe try lab -o try",
    )
    def try_folder(
        folder: Annotated[Path, typer.Argument(help="Folder with recordings, in any format that ingest reads.")],
        output: Annotated[Path, typer.Option("-o", "--output", help="Directory to write.")] = Path("try"),
        opens: Opens = False,
    ) -> None:
        from tacpipe.cli import first_try

        _show_page(first_try.run(folder, output), opens=opens)


def _add_version(program: typer.Typer) -> None:
    """Add the command ``version``, which prints the versions of the parts."""

    @program.command("version", help=SUMMARIES["version"] + "\n\nExample: tacpipe version --json")
    def version(as_json: AsJson = False) -> None:
        from tacpipe.cli import versions

        _print(versions.of_parts(), versions.to_text, as_json=as_json)


def _from_module(name: str) -> Callable[[typer.Typer], None]:
    """Return a function that imports the module of a command and adds the command."""

    def add(program: typer.Typer) -> None:
        importlib.import_module(f"tacpipe.cli.{name}").add(program, SUMMARIES.get(name) or registry.group_help(name))

    return add


def _show_page(page: Path, *, opens: bool) -> None:
    """Print the path of a page, and open it in a browser if it ``opens``."""
    terminal.result(page)
    if opens and page.is_file():
        import webbrowser

        webbrowser.open(page.resolve().as_uri())


def _print(value: Any, to_text: Callable[..., str], *, as_json: bool, **options: Any) -> None:
    with _ends_with_its_reader():
        terminal.result_json(value) if as_json else terminal.result(to_text(value, **options))


@contextlib.contextmanager
def _ends_with_its_reader() -> Iterator[None]:
    """End this process silently if the reader of stdout has gone, as Unix tools do: `tacpipe show DATASET | head`.

    Outside of this context, a lost connection raises an error instead.
    """
    before = signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    try:
        yield
        sys.stdout.flush()
    finally:
        signal.signal(signal.SIGPIPE, before)


NAMES: dict[str, Callable[[typer.Typer], None]] = {
    "acquire": _from_module("acquire"),
    "live": _from_module("live"),
    "label": _add_label,
    "show": _add_show,
    "check": _from_module("check"),
    "compare": _add_compare,
    "track": _add_track,
    "view": _from_module("view"),
    "explain": _add_explain,
    "sensors": _from_module("sensors"),
    "store": _from_module("store"),
    "candidates": _from_module("candidates"),
    "demo": _add_demo,
    "try": _add_try,
    "version": _add_version,
}


def summary(name: str) -> str:
    """Return the one-line summary of a command, from `SUMMARIES` or from the docstring of the command's module."""
    return SUMMARIES.get(name) or registry.group_help(name).partition("\n")[0]


SHOWN = 20  # Maximum number of recordings whose changes are printed


def refuse_others(*others: object, option: str = "--from") -> None:
    """Raise `UsageError` if one of ``others``, options that exclude ``option``, has a value."""
    if any(other is not None and other is not False and other != [] for other in others):
        raise UsageError(
            f"{option} names recordings and labels itself. Leave out names, --label, --interval, --exclude and --include."
        )


def note_labels(dataset: Path) -> None:
    """Print a note for labels of a dataset that are written in several ways."""
    from tacpipe.datasets import consistency, labels, manifest

    for sentence in consistency.label_notes(labels.attributes(manifest.find(dataset).manifest)):
        terminal.note(f"tacpipe: {sentence}")


def label_intervals(dataset: Path, path: Path, *, as_json: bool) -> None:
    """Replace the labelled intervals of the recordings in a CSV, and print the dataset's path or JSON.

    Raises `TacpipeError` if the file cannot be read or names a recording that does not exist.
    """
    from tacpipe.datasets import labels
    from tacpipe.formats.table.label_table import read_intervals

    new_labels = read_intervals(path)
    changed = labels.change_each(dataset, lambda current: labels.require_recordings(new_labels, current, path))
    if as_json:
        value = {"schema_version": 1, "output": str(changed.directory)}
        terminal.result_json({**value, "recordings": changed.recordings, "labels": new_labels})
        return
    terminal.note(f"{len(changed.recordings)} of {len(new_labels)} recordings changed")
    terminal.result(changed.directory)


def check_labels_without_table(names: Sequence[str] | None, key: str, dry_run: bool) -> None:
    """Check the options of a call without --from. Raises `UsageError` if one needs it, or if no recording is named."""
    if key or dry_run:
        raise UsageError("--key and --dry-run belong to --from. Leave them out, or give a table with --from.")
    if not names:
        raise UsageError("Name the recordings to label (* and ? are wildcards), or give a table with --from.")


def label_from_table(dataset: Path, path: Path, key: str, *, dry_run: bool, as_json: bool) -> None:
    """Set the labels in a table on a dataset's recordings, or only print the changes if ``dry_run`` is true.

    Recordings without a row are reported. ``key`` is the column with the names of recordings, "" to detect it. Raises
    `TacpipeError` if the file cannot be read or does not match.
    """
    from tacpipe.datasets import labels
    from tacpipe.formats.table.label_table import LabelTable, read_label_table

    tables_read: list[LabelTable] = []

    def labels_for(current_labels: labels.ByRecording) -> labels.ByRecording:
        tables_read.append(read_label_table(path, key, current_labels))
        return tables_read[-1].by_recording(current_labels)

    current, changes = labels.planned(dataset, labels_for)
    unmatched = sorted(set(current) - set(tables_read[-1].by_recording(current)))
    value = {"schema_version": 1, "output": str(dataset), "key": tables_read[-1].key, "without": unmatched}
    if dry_run:
        if as_json:
            terminal.result_json({**value, "recordings": sorted(changes), "labels": changes})
        else:
            terminal.result(_describe_changes(current, changes, len(current), unmatched))
        return
    changed = labels.change_each(dataset, labels_for) if changes else None
    note_labels(dataset)
    if unmatched:
        terminal.note(f"tacpipe: {path} has no row for {len(unmatched)} recordings: {listed(unmatched)}.")
    if as_json:
        terminal.result_json({**value, "recordings": [] if changed is None else changed.recordings, "labels": changes})
        return
    terminal.note(f"{len(changes)} of {len(current)} recordings changed")
    terminal.result(dataset if changed is None else changed.directory)


def _describe_changes(
    current: Mapping[str, Mapping[str, Attribute]],
    changes: Mapping[str, Mapping[str, Attribute]],
    count: int,
    unmatched: Sequence[str],
) -> str:
    """Return a text with a line per recording whose labels would change, the recordings without a row, and a total."""
    lines = []
    for name, labels in sorted(changes.items())[:SHOWN]:
        old = current[name]
        texts = [f"{plain(key)} {_format_value(old.get(key))} → {_format_value(new)}" for key, new in labels.items()]
        lines.append(f"{plain(name)}: {', '.join(texts)}")
    lines += [f"… and {len(changes) - SHOWN} more"] if len(changes) > SHOWN else []
    lines += [f"no row for {listed(unmatched)}"] if unmatched else []
    return "\n".join([*lines, f"{len(changes)} of {count} recordings would change"])


def _format_value(value: Any) -> str:
    return "none" if value is None else excerpt(value)
