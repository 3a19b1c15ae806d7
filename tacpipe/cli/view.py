"""Add the command ``tacpipe view``, which shows recordings in Rerun's viewer or a browser, or saves them as a file."""

from __future__ import annotations

import tempfile
import time
import webbrowser
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import tacpipe
from tacpipe.datasets import labels, replacing
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io import terminal
from tacpipe.io.files import readable_errors, write_whole
from tacpipe.plugins import extras
from tacpipe.plugins.stage import Attribute

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Recording
    from tacpipe.viewer.contents import DrawnContents

EXAMPLE = (
    "\n\nShows taxels at the cursor, streams, contacts, labels, gaps, the arm, clouds and cameras. The viewer lists "
    "several recordings. Nothing is sent over the network."
    "\n\nExample: tacpipe view data/recordings trial-003 --predictions data/predictions"
)
MAGIC, ENDING = b"RRF", ".rrd"  # first bytes and suffix of a Rerun file
LIMIT = 8


def add(program: typer.Typer, summary: str) -> None:
    """Add the command ``view`` to ``program``."""
    program.command("view", help=summary + EXAMPLE)(view)


def view(
    dataset: Annotated[Path, typer.Argument(help="A dataset of recordings.")],
    recording: Annotated[
        list[str] | None, typer.Argument(help="Names of recordings; * and ? match any letters. All by default.")
    ] = None,
    where: Annotated[
        list[str] | None, typer.Option("--where", help="Only recordings with this label, as name=value.")
    ] = None,
    split: Annotated[Path | None, typer.Option("--split", help="Only recordings of this split.")] = None,
    role: Annotated[
        str | None, typer.Option("--role", help="Only those with this role: train, val, calibration or test.")
    ] = None,
    fold: Annotated[int, typer.Option("--fold", help="Fold of the split.")] = 0,
    predictions: Annotated[
        Path | None, typer.Option("--predictions", help="Output of `tacpipe predict` or `tacpipe evaluate`.")
    ] = None,
    video: Annotated[
        Path | None,
        typer.Option("--video", help="Dataset with the cameras of these recordings; markers are drawn in its frames."),
    ] = None,
    limit: Annotated[int, typer.Option("--limit", min=1, help="Maximum number of recordings, by name.")] = LIMIT,
    all_rows: Annotated[
        bool,
        typer.Option(
            "--all-rows", help="Draw every row of streams over 30,000 rows instead of their envelope; slower."
        ),
    ] = False,
    save: Annotated[
        Path | None,
        typer.Option("--save", help="Write a file (.rrd) for the viewer instead, or a folder with one per recording."),
    ] = None,
    web: Annotated[bool, typer.Option("--web", help="Open in the browser instead, until Ctrl-C.")] = False,
    port: Annotated[int | None, typer.Option("--port", help="Port of --web; 9090 or a free one by default.")] = None,
) -> None:
    """Show recordings on one time axis."""
    _require(save, web=web, port=port)
    extras.require("tacpipe view", "rerun", "rerun_cli")
    chosen = _select_recordings(dataset, recording or [], where or [], split, role, fold)
    recordings = list(chosen)[:limit]
    if save is not None and len(recordings) > 1 and save.suffix.lower() == ENDING:
        raise UsageError(
            f"{save} is one file for one recording, and {len(recordings)} are selected. Select one, or give a folder for a "
            f"file each."
        )
    if len(recordings) < len(chosen):
        terminal.note(f"{len(recordings)} of {len(chosen)} recordings; --limit {len(chosen)} shows all.")
    with tempfile.TemporaryDirectory(prefix="tacpipe-view-") as folder, extras.explain_missing("tacpipe view"):
        from tacpipe.viewer import session

        drawn = _collect_contents(recordings, _opened(predictions), _opened(video))
        files = session.write(drawn, Path(folder), str(dataset), with_list=len(recordings) > 1, all_rows=all_rows)
        if save is not None:
            _save(files, save)
            terminal.result(save)
        elif web:
            _show_in_browser(files, port)
        else:
            _show_in_window(files)


def _require(save: Path | None, *, web: bool, port: int | None) -> None:
    """Raise `UsageError` before reading data if options conflict or a file belongs to another program."""
    if save is not None and web:
        raise UsageError("--save and --web contradict each other. Give only one.")
    if port is not None and not web:
        raise UsageError(f"--port {port} is the port of --web; give --web too.")
    if save is not None and save.suffix.lower() == ENDING:
        replacing.refuse_foreign(save, MAGIC)
    elif save is not None and (save.suffix or save.is_file()):
        raise UsageError(f"{save} must end in {ENDING}, by which Rerun's viewer knows its files, or be a folder.")


def conditions(where: Sequence[str]) -> dict[str, Attribute]:
    """Parse labels of the form ``name=value``; numbers and true, false, null are read as in YAML.

    Raises `UsageError` for any other form.

    >>> conditions(["object=cup", "trial=3"])
    {'object': 'cup', 'trial': 3}
    """
    conditions_by_name = {}
    for text in where:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise UsageError(f"--where {text} should read name=value, as in --where object=cup.")
        conditions_by_name[name] = labels.of_text(value)
    return conditions_by_name


def _select_recordings(
    path: Path, names: Sequence[str], label_texts: Sequence[str], split: Path | None, role: str | None, fold: int
) -> Dataset:
    """Return the recordings that the options select. Raises `UsageError` if the dataset has none."""
    required_labels = conditions(label_texts)
    opened = tacpipe.open(path)
    if not len(opened):
        raise UsageError(f"{path} has no recordings; `tacpipe view` shows those of a dataset of recordings.")
    return opened.select(*names, split=split, role=role, fold=fold, labels=required_labels)


def _collect_contents(
    recordings: Sequence[Recording], predictions: Dataset | None, videos: Dataset | None
) -> Iterator[DrawnContents]:
    """Yield the contents of each recording, with a note if its predictions or video are missing.

    Raises `UsageError` for a recording with nothing to draw.
    """
    from tacpipe.viewer import contents

    for recording in recordings:
        table, row = None, None
        if predictions is not None:
            table, row = predicted(predictions, recording.name)
            if table is None and row is None:
                terminal.note(f"There are no predictions of {recording.name} in {predictions.path}.")
        video = None if videos is None else videos.recordings.get(recording.name)
        if videos is not None and video is None:
            terminal.note(f"There is no video of {recording.name} in {videos.path}.")
        chain = recording.alone.source.chain
        recording_contents = contents.collect(recording, table, row, chain=chain, video=video)
        if recording_contents.is_empty:
            raise UsageError(
                f"Recording {recording.name} has no stream with times and no cloud, so there is nothing to draw; "
                f"its streams are {', '.join(map(repr, recording.streams))}. Give a dataset of recordings."
            )
        yield recording_contents


def _opened(path: Path | None) -> Dataset | None:
    return None if path is None else tacpipe.open(path)


def predicted(predictions: Dataset, name: str) -> tuple[Any, Any]:
    """Return a recording's predictions: its own table, and its row in a table of all recordings, or None for each."""
    if name in predictions:
        return predictions[name].table(), None
    for recording in predictions:
        if recording.streams != ("",):
            continue
        table = recording.table()
        if "recording" in table.column_names:
            names = table.column("recording").to_pylist()
            if name in names:
                return None, table.slice(names.index(name), 1)
    return None, None


def _save(files: Sequence[Path], save: Path) -> None:
    """Write a single file to ``save``, or several into the folder ``save``.

    Raises `UsageError` for files of other programs.
    """
    paths = [save] if save.suffix.lower() == ENDING else [save / file.name for file in files]
    for path in paths:
        replacing.refuse_foreign(path, MAGIC)
    with readable_errors(save.parent):
        for file, path in zip(files, paths, strict=True):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(str(path), file.read_bytes(), f"{path}.draft")


def _show_in_window(files: Sequence[Path]) -> None:
    """Show the files in the viewer's window until it is closed. Raises `TacpipeError` if the viewer fails."""
    from tacpipe.viewer import session

    terminal.note("The viewer is open; close it or press Ctrl-C to end.")
    code = session.show(files)
    if code:
        raise TacpipeError(
            f"The viewer ended with {code}. It needs a screen and Vulkan or OpenGL; without them give --web, or "
            f"--save FILE.rrd and open that on another computer."
        )


def _show_in_browser(files: Sequence[Path], port: int | None) -> None:
    """Serve the files to a browser on this computer, and open it, until Ctrl-C. Raises the errors of `serve`."""
    from tacpipe.viewer.session import serve

    with serve(files, port) as address:
        terminal.result(address)
        webbrowser.open(address)
        terminal.note("The viewer is served on this computer; press Ctrl-C to end.")
        while True:
            time.sleep(1)
