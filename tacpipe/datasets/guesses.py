"""Names that people try on datasets and recordings before they read the documentation, each with what does it."""

from __future__ import annotations

from collections.abc import Mapping

DATASET = {
    **dict.fromkeys(("head", "tail", "info", "describe", "df", "data"), "to_pandas(STREAM) returns a DataFrame"),
    **dict.fromkeys(("filter", "query", "where"), 'select("trial-00?", object="cup") selects recordings'),
    **dict.fromkeys(("train", "val", "test"), 'select(split="data/split", role="train") selects a role of a split'),
    **dict.fromkeys(("keys", "items", "values"), "names lists the recordings, and a loop yields them"),
    **dict.fromkeys(("predict", "evaluate", "model"), "tacpipe.load(PATH) returns a model that predicts"),
    **dict.fromkeys(("plot", "show"), "`tacpipe report DATASET -o report.html` draws recordings"),
    "shape": "len() is the number of recordings, and recording.rows the number of rows of each stream",
    "attributes": "labels is a table of the attributes",
    "columns": "streams lists the columns of each stream",
}
RECORDING = {
    **dict.fromkeys(("head", "tail", "describe", "df", "data", "values"), "to_pandas(STREAM) returns a DataFrame"),
    **dict.fromkeys(("plot", "show"), "`tacpipe show DATASET RECORDING --plot curves.html` draws it"),
    **dict.fromkeys(("labels", "metadata", "info"), "attributes has the labels"),
    **dict.fromkeys(("shape", "size"), "rows has the number of rows of each stream"),
    **dict.fromkeys(
        ("to_numpy", "numpy", "to_torch"), "dataset.to_numpy(STREAM) and to_torch return arrays by recording"
    ),
    **dict.fromkeys(("duration", "duration_s", "t", "time"), "column t_ns of a stream is the time in ns"),
}
MODULE = {
    **dict.fromkeys(("read", "load_dataset", "open_dataset", "Data"), "tacpipe.open(PATH) opens a dataset"),
    **dict.fromkeys(("load_model", "Model", "predict"), "tacpipe.load(PATH) returns a model that predicts"),
    **dict.fromkeys(
        ("train", "evaluate", "synchronize", "segment", "split", "ingest", "report", "compress", "simulate", "extract"),
        'tacpipe.run("STAGE", DATASET, output=PATH) runs a command\'s stage, such as "train forward"',
    ),
}


def missing(owner: str, name: str, guesses: Mapping[str, str]) -> AttributeError:
    """Return the error for a missing attribute of ``owner``; if ``guesses`` has it, with what does the same."""
    hint = f"; {guesses[name]}" if name in guesses else ""
    return AttributeError(f"{owner} has no attribute {name!r}{hint}.")
