"""Check labels: spellings, kinds of values, classes with few recordings. Reads no data."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping

from tacpipe.channels.schema import TRUTH
from tacpipe.checks.check import Check, CheckFinding
from tacpipe.datasets.consistency import normal_spelling
from tacpipe.datasets.dataset import Dataset
from tacpipe.datasets.selection import RecordingAttributes
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import listed, plain

FEW, USUAL = 2, 10  # largest number of recordings of a small class, and smallest median number of all classes
_SHOWN = 4


class LabelValues(Check):
    """Find labels whose values are probably meant to be equal, and small classes."""

    def conclude(self, dataset: Dataset) -> Iterator[CheckFinding]:
        """Yield the findings for all labels."""
        attributes = dict(RecordingAttributes(dataset).items())
        names = {name for labels in attributes.values() for name in labels if not name.startswith(TRUTH)}
        yield from label_findings(attributes, sorted(names))


def label_findings(attributes: Mapping[str, Mapping[str, Attribute]], names: Iterable[str]) -> Iterator[CheckFinding]:
    """Yield the findings for the labels ``names``; ``attributes`` are those of each recording."""
    for name in names:
        values = {
            recording: value for recording, labels in attributes.items() if (value := labels.get(name)) is not None
        }
        texts = Counter(value for value in values.values() if isinstance(value, str))
        spellings: dict[str, list[str]] = {}
        for text in sorted(texts):
            spellings.setdefault(normal_spelling(text), []).append(text)
        for variants in spellings.values():
            if len(variants) > 1:
                usual = max(variants, key=lambda text: texts[text])
                rare = {recording for recording, value in values.items() if value in variants and value != usual}
                yield _finding(
                    "label-variants",
                    name,
                    f"{listed(map(repr, variants), _SHOWN)} of the label {plain(name)} differ only in case or space.",
                    f"`tacpipe label DATASET RECORDING --label {name}={usual}`",
                    {recording: values[recording] for recording in rare},
                )
        other_values = {recording: value for recording, value in values.items() if not isinstance(value, str)}
        if texts and other_values:
            examples = listed(dict.fromkeys(map(repr, [*texts, *other_values.values()][-_SHOWN:])))
            minority = (
                other_values
                if len(other_values) <= len(values) / 2
                else {name: text for name, text in values.items() if text in texts}
            )
            yield _finding(
                "label-kinds",
                name,
                f"The label {plain(name)} has texts and other values, such as {examples}.",
                'quote the text where the label is written, as "no"; `tacpipe label` sets it',
                minority,
            )
        counts = Counter(values.values())
        usual_count = sorted(counts.values())[len(counts) // 2] if counts else 0
        small = {recording: value for recording, value in values.items() if counts[value] <= FEW}
        if len(counts) > 2 and usual_count >= USUAL and small:
            yield _finding(
                "small-classes",
                name,
                f"{listed(dict.fromkeys(map(repr, small.values())), _SHOWN)} of the label {plain(name)} has only "
                f"{FEW} recordings or fewer; most values have {usual_count} or more.",
                "record more, or `tacpipe label RECORDING --exclude REASON`",
                small,
            )


def _finding(kind: str, name: str, sentence: str, repair: str, values: Mapping[str, Attribute]) -> CheckFinding:
    content = [f"{recording}={value!r}" for recording, value in values.items()]
    return CheckFinding(kind, name, sentence, repair, dict.fromkeys(sorted(values), ()), content)
