"""Run the whole pipeline on a folder of files: guess what they are, read, check, prepare, learn and report."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.cli import demo, steps
from tacpipe.errors import DONE, FAILED, UsageError
from tacpipe.io import terminal
from tacpipe.plugins import extras
from tacpipe.printable import listed
from tacpipe.scores import headline

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

FORMATS = {  # format of `tacpipe ingest` by ending; other files are tables
    **{".mcap": "mcap", ".bag": "rosbag", ".db3": "rosbag"},
    **{".h5": "hdf5", ".hdf5": "hdf5", ".xdf": "xdf"},
}
MARKS = {"meta/info.json": "lerobot", ".zgroup": "zarr", "zarr.json": "zarr"}  # format by a file of a folder
MIN_RECORDINGS = 4  # recordings of each label, so that training and test have some
MAX_LABELS = 20
MANY_RECORDINGS = 30  # recordings from which some are for validation
MEASURED = ("force", "torque")  # quantities that are learned if there is no label
NAME = "The try"  # in errors
NEXT = """Each line after $ is a command that you can change and run again. After a change of {output}/layout.toml or of
labels, `tacpipe try {folder} -o {output}` computes what depends on it."""


def run(folder: Path, output: Path) -> Path:
    """Run the pipeline on the files of ``folder``; write guesses, datasets, model and report below ``output``.

    Prints each command. A layout that exists there is used as it is; without one, that of tables is guessed. Returns the
    path of the report, or of the recordings if nothing can be learned from them. Raises `UsageError` if the folder does
    not exist, and `TacpipeError` if a command fails.
    """
    if not folder.exists():
        raise UsageError(f"{folder} does not exist. Give a folder with recordings.")
    extras.require("tacpipe try", *demo.LEARNING)
    layout, recordings = output / "layout.toml", output / "recordings"
    kind = format_of(folder)
    if kind == "table" and not layout.exists():
        guess = _run("ingest", kind, str(folder), "--guess", output="returned")
        output.mkdir(parents=True, exist_ok=True)
        layout.write_text(complete(guess))
        terminal.note(f"The guess is written to {layout}. Correct it there, and run the same command again.")
    given = ["--layout", str(layout)] if layout.exists() else []
    _run("ingest", kind, str(folder), *given, "-o", str(recordings))
    steps.run(["check", str(recordings)], NAME, "shown", codes=(DONE, FAILED))  # FAILED: there are findings

    import tacpipe

    dataset = tacpipe.open(recordings)
    commands = commands_after(dataset, output)
    for words in commands:
        _run(*words)
    if not commands or commands[-1][0] != "report":
        terminal.note(_why_nothing_is_learned(dataset, kind, folder, output))
        return recordings
    terminal.note(demo.headline_of(output / "results"))
    terminal.note(NEXT.format(folder=folder, output=output))
    return output / "report.html"


def _why_nothing_is_learned(dataset: Dataset, kind: str, folder: Path, output: Path) -> str:
    """Return what the recordings lack, and how to add it."""
    quantities, layout = stream_quantities(dataset), output / "layout.toml"
    again = f"then run `tacpipe try {folder} -o {output}` again."
    if not any({"tactile", "frame"} & found for found in quantities.values()):
        written = (
            "" if layout.exists() else f"write a layout with `tacpipe ingest {kind} {folder} --guess > {layout}`, "
        )
        return (
            f"No column has the quantity tactile; the streams are {listed(quantities)}. To say which is touch, {written}add "
            f'quantity = "tactile" to its columns in {layout}, {again}'
        )
    return (
        f"Nothing is learned: no label has two values of {MIN_RECORDINGS} recordings each, and no stream besides touch has "
        f"a force or torque. Add labels with `tacpipe label {output / 'recordings'} NAME --label object=cup`, {again}"
    )


def _run(*words: str, output: steps.Output = "ignored") -> str:
    return steps.run(words, NAME, output)


def format_of(folder: Path) -> str:
    """Return the format of `tacpipe ingest` that reads the files of a folder, or one file: the most frequent one."""
    marked = [kind for mark, kind in MARKS.items() if (folder / mark).exists() or any(folder.glob(f"*/{mark}"))]
    files = [folder] if folder.is_file() else [path for path in folder.rglob("*") if path.is_file()]
    kinds = Counter(FORMATS[path.suffix] for path in files if path.suffix in FORMATS)
    return (marked or [kind for kind, _ in kinds.most_common(1)] or ["table"])[0]


def complete(guess: str) -> str:
    """Return a guessed layout in which what is unknown is left out: columns are kept, without quantity and unit.

    >>> complete('{ match = "x", quantity = "?", unit = "?", type = "float64" }')
    '{ match = "x", type = "float64" }'
    """
    return re.sub(r'(?m)^sensor = "\?".*\n|, (?:quantity|unit) = "\?"', "", guess)


def commands_after(dataset: Dataset, output: Path) -> list[list[str]]:
    """Return the commands, without ``tacpipe``, that follow the ingest of ``dataset`` to ``output``/recordings.

    There are none without touch or frames. Streams of frames become channels if no stream has tactile channels, and
    several streams become one. Then the label with the most recordings of its rarest value is learned, or else the force
    or torque of another stream. Without either, the last command is not ``report``.
    """
    current, commands = str(output / "recordings"), list[list[str]]()
    quantities = stream_quantities(dataset)
    if not any({"tactile", "frame"} & found for found in quantities.values()):
        return commands
    if not any("tactile" in found for found in quantities.values()) and any(
        "frame" in found for found in quantities.values()
    ):
        commands.append(["extract", "difference", current, "-o", str(output / "channels")])
        current = commands[-1][-1]
    label, target = best_label(dataset), None
    if label is None:
        target = next(
            (
                (stream, quantity)
                for stream, found in quantities.items()
                for quantity in MEASURED
                if stream and quantity in found and "tactile" not in found
            ),
            None,
        )
    if len(quantities) > 1:
        truth = [] if target is None else ["--truth", f"{target[0]}_*"]
        commands.append(["synchronize", current, *truth, "-o", str(output / "synced")])
        current = commands[-1][-1]
    test = min(0.5, max(0.2, headline.MIN_CLUSTERS / len(dataset)))
    val = 0.15 if len(dataset) >= MANY_RECORDINGS else 0  # each label needs recordings for training
    split, model, results = (str(output / name) for name in ("split", "model", "results"))
    if label is not None:
        task = ["classify", "--label", label]
    elif target is not None:
        task = ["regress", "--target", f"{target[0]}_*{target[1]}*"]
    else:
        return commands
    return [
        *commands,
        [
            "split",
            current,
            "-o",
            split,
            "--test",
            f"{test:.2f}",
            "--val",
            f"{val:g}",
            *(["--stratify", label] if label else []),
        ],
        ["train", task[0], current, "--split", split, *task[1:], "-o", model],
        ["evaluate", model, current, "--split", split, "-o", results],
        ["report", results, "-o", str(output / "report.html")],
    ]


def stream_quantities(dataset: Dataset) -> dict[str, set[str]]:
    """Return the quantities of each stream of the first recording, and "frame" for a stream of frames."""
    from tacpipe.video.stream import PACKET

    first = next(iter(dataset))
    found: dict[str, set[str]] = {}
    for stream in first.streams:
        schema = first.columns(stream).schema
        found[stream] = {(field.metadata or {}).get(b"quantity", b"").decode() for field in schema}
        found[stream] |= {"frame"} if PACKET in schema.names else set()
    return found


def best_label(dataset: Dataset) -> str | None:
    """Return the label with 2 to `MAX_LABELS` texts, each on at least `MIN_RECORDINGS` recordings, or None.

    Of several, the one whose rarest value has the most recordings.
    """
    counts: dict[str, int] = {}
    for name, column in dataset.labels.items():
        values = Counter(value for value in column if isinstance(value, str) and value)
        if 2 <= len(values) <= MAX_LABELS and min(values.values()) >= MIN_RECORDINGS:
            counts[str(name)] = min(values.values())
    return max(counts, key=lambda name: counts[name]) if counts else None
