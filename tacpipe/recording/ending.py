"""Name how recordings end, and describe those that were cut off or whose recorder was delayed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tacpipe.printable import plain

COMPLETED, INTERRUPTED, RECOVERED = "completed", "interrupted", "recovered"  # values of the attribute `ended`
REASONS = {
    INTERRUPTED: "interrupted before its end",
    RECOVERED: "recovered after a crash or a loss of power",
}
MOST = 20  # lines
UNCERTAIN = "_uncertain_samples"


def describe_incomplete(
    attributes: Mapping[str, Mapping[str, Any]], recordings: Mapping[str, Mapping[str, Any]]
) -> list[str]:
    """Return one line per recording that was cut off, and one per recording with uncertain arrivals.

    ``attributes`` has the attributes of each recording, ``recordings`` the figures of its streams.
    """
    lines = []
    for name in sorted(attributes):
        values = attributes[name]
        if values.get("ended") in REASONS:
            figures = recordings.get(name, {}).values()
            durations_s = [stream["duration_s"] for stream in figures if "duration_s" in stream]
            requested_s = values.get("requested_duration_s")
            part = f" of {requested_s:g}" if isinstance(requested_s, int | float) else ""
            duration = f", {max(durations_s):.1f}{part} s" if durations_s else ""
            lines.append(f"not completed: {plain(name)}: {REASONS[values['ended']]}{duration}")
        late = {stream: count for stream, count in values.items() if stream.endswith(UNCERTAIN)}
        if late:
            described = ", ".join(
                f"{count} samples of {plain(key.removesuffix(UNCERTAIN))}" for key, count in late.items()
            )
            lines.append(f"recorder held up: {plain(name)}: the arrival of {described} is uncertain")
    return lines[:MOST] + ([f"… and {len(lines) - MOST} more"] if len(lines) > MOST else [])
