"""Find labels and columns that differ between the recordings of a dataset, although one thing was probably meant."""

from __future__ import annotations

import unicodedata
from collections import Counter
from collections.abc import Mapping, Sequence

from tacpipe.plugins.stage import Attribute
from tacpipe.printable import listed, plain

_NAMED = 5  # maximum number of columns or recordings that a note names


def label_notes(attributes_by_recording: Mapping[str, Mapping[str, Attribute]]) -> list[str]:
    """Return a sentence for each set of label values that differ only in case, spaces or Unicode form.

    >>> label_notes({"a": {"material": "cork"}, "b": {"material": "Cork "}, "c": {"material": "foam"}})
    ["The label material is written in several ways: 'Cork ' (1), 'cork' (1). Write it in one way; `tacpipe label` does."]
    """
    spellings: dict[tuple[str, str], Counter[str]] = {}
    for attributes in attributes_by_recording.values():
        for name, value in attributes.items():
            if value is not None and not isinstance(value, float):
                spellings.setdefault((name, normal_spelling(str(value))), Counter())[repr(value)] += 1
    notes = []
    for (name, _), counts in sorted(spellings.items()):
        if len(counts) > 1:
            values = listed([f"{_shown(value)} ({count})" for value, count in sorted(counts.items())], _NAMED)
            notes.append(
                f"The label {plain(name)} is written in several ways: {values}. Write it in one way; `tacpipe label` does."
            )
    return notes


def normal_spelling(text: str) -> str:
    """Return a label without differences in case, spaces, underscores or Unicode form.

    >>> normal_spelling(" Soft_Foam"), normal_spelling("soft foam")
    ('soft foam', 'soft foam')
    """
    return " ".join(unicodedata.normalize("NFKC", text).casefold().replace("_", " ").split())


def _shown(value: str) -> str:
    """Return the text of a label in Python's notation, with letters that look like others escaped."""
    is_plain = value.isprintable() and unicodedata.is_normalized("NFKC", value)
    return value if is_plain else value.encode("unicode_escape").decode()


def column_notes(columns_by_recording: Mapping[str, Mapping[str, Sequence[str]]]) -> list[str]:
    """Return a sentence for the columns of each stream that are missing in some recordings, with their names.

    >>> column_notes({"t0": {"skin": ["T1", "T2"]}, "t1": {"skin": ["T1"]}, "t2": {"skin": ["T1", "T2"]}})
    ['skin has no T2 in 1 of 3 recordings: t1.']
    """
    recordings_by_columns: dict[str, dict[tuple[str, ...], list[str]]] = {}
    for recording, streams in columns_by_recording.items():
        for stream, columns in streams.items():
            recordings_by_columns.setdefault(stream, {}).setdefault(tuple(columns), []).append(recording)
    notes = []
    for stream, groups in sorted(recordings_by_columns.items()):
        columns_by_absence: dict[tuple[str, ...], list[str]] = {}
        for column in dict.fromkeys(column for columns in groups for column in columns):
            absent = sorted(name for columns, names in groups.items() if column not in columns for name in names)
            if absent:
                columns_by_absence.setdefault(tuple(absent), []).append(column)
        count = sum(map(len, groups.values()))
        notes += [
            f"{plain(stream) or 'The table'} has no {listed(missing, _NAMED)} in {len(absent)} of {count} recordings: "
            f"{listed(absent, _NAMED)}."
            for absent, missing in columns_by_absence.items()
        ]
    return notes
