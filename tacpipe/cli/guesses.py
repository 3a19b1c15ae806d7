"""Words that people type in place of a command, each with the command that does it."""

from __future__ import annotations

from collections.abc import Sequence

TABLES = (
    "`tacpipe ingest table FOLDER --guess` drafts a layout for CSV, Excel, Parquet, NPY, JSON lines, images and videos"
)
COMMANDS = {
    **dict.fromkeys(("record", "capture", "log"), "`tacpipe acquire RIG -o DATASET` records"),
    **dict.fromkeys(
        ("import", "convert", "load", "read", "add"), "`tacpipe ingest FORMAT FOLDER -o DATASET` reads files"
    ),
    **dict.fromkeys(
        ("list", "ls", "info", "describe", "head", "cat", "open"), "`tacpipe show DATASET` describes a dataset"
    ),
    **dict.fromkeys(("plot", "draw"), "`tacpipe show DATASET RECORDING --plot curves.html` draws a recording"),
    **dict.fromkeys(
        ("delete", "remove", "rm", "clean", "gc"), "delete the folder of a dataset and run `tacpipe store gc`"
    ),
    **dict.fromkeys(("sync", "align", "resample"), "`tacpipe synchronize DATASET -o DATASET` makes rows of streams"),
    **dict.fromkeys(("test", "eval", "score"), "`tacpipe evaluate MODEL DATASET -o RESULT` measures a model"),
    **dict.fromkeys(("annotate", "tag"), "`tacpipe label DATASET RECORDINGS --set NAME=VALUE` sets labels"),
    "run": "stages are commands, as in `tacpipe synchronize`",
    "help": "`tacpipe -h` lists the commands",
}
FORMATS = {
    **dict.fromkeys(
        ("csv", "tsv", "excel", "xlsx", "npy", "npz", "parquet", "json", "jsonl", "images", "video"), TABLES
    ),
    **dict.fromkeys(("h5", "hdf", "robomimic"), "`tacpipe ingest hdf5 FOLDER -o DATASET` reads HDF5"),
    **dict.fromkeys(("bag", "bags", "ros", "ros2", "db3"), "`tacpipe ingest rosbag FOLDER -o DATASET` reads bags"),
}


def explain(group: str, word: str, names: Sequence[str], message: str) -> str:
    """Return the message about an unknown command of a group, such as ``tacpipe ingest``, with what may be meant."""
    kind = group.rpartition(" ")[2]
    guesses = {"tacpipe": COMMANDS, "ingest": FORMATS}.get(kind, {})
    if word in guesses:
        return f"{message.partition('.')[0]}: {guesses[word]}."
    if kind == "tacpipe" or "Did you mean" in message:
        return message
    hint = f" {TABLES}." if kind == "ingest" else ""
    return f"{message} {group} needs one of {', '.join(names)} before {word}.{hint}"
