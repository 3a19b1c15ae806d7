"""Find what concerns a training or an evaluation, from labels and digests only; no data are read."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from tacpipe.checks.labels import label_findings
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import listed

_SHOWN = 3


def describe(
    attributes: Mapping[str, Mapping[str, Attribute]],
    labels: Iterable[str],
    equal: Sequence[Sequence[str]],
    roles: Mapping[str, str],
) -> str:
    """Return one line on findings in ``labels``, and on ``equal`` recordings whose ``roles`` differ; "" if none."""
    sentences = [finding.sentence.rstrip(".") for finding in label_findings(attributes, labels)]
    groups = [[name for name in group if name in roles] for group in equal]
    separate = [group for group in groups if len({roles[name] for name in group}) > 1]
    if separate:
        examples = listed([" = ".join(f"{name} ({roles[name]})" for name in group) for group in separate], _SHOWN)
        sentences.append(f"Recordings with equal content have different roles: {examples}")
    return f"{'; '.join(sentences)}. `tacpipe check` lists all findings." if sentences else ""
