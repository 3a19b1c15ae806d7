"""What a command did: counts, bad recordings, and what its user should know of results that are valid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tacpipe.engine import execution, provenance
from tacpipe.errors import TacpipeError
from tacpipe.plugins import registry
from tacpipe.printable import listed

_NAMED = 5  # recordings that a note names
_FROM_RECORDS = ("stated", "code", "packages", "unlike")  # fields that `describe_results` puts into words


@dataclass
class Outcome:
    """What a command did."""

    output: Path
    key: str = ""
    ran: int = 0
    reused: int = 0
    rows: int = 0
    seconds: float = 0.0
    bad: dict[str, str] = field(default_factory=dict)
    differs: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    stated: dict[str, list[str]] = field(default_factory=dict)  # note of a stage to the recordings that it is about
    code: dict[str, dict[str, int]] = field(default_factory=dict)  # stage to digest of its code to number of results
    packages: dict[str, dict[str, int]] = field(default_factory=dict)  # the same by plug-in package
    unlike: list[str] = field(default_factory=list)  # in what the computers of results that differ are not the same

    def begin(self) -> None:
        """Count nothing and restore nothing: what the store answers, or what is computed, is added from here."""
        self.ran = self.reused = 0
        self.restore({})

    def add_record(self, stage: str, recording: str, record: Mapping[str, Any]) -> None:
        """Add what the record of one result holds besides it: notes, and the code that it was computed by."""
        made = record["provenance"]
        for note in made.get("notes") or ():
            self.stated.setdefault(note, []).append(recording)
        if made.get("code"):
            _add_counts(self.code, {stage: {made["code"]: 1}})
        _add_counts(self.packages, {package: {code: 1} for package, code in (made.get("packages") or {}).items()})

    def add_group(self, kept: Mapping[str, Any]) -> None:
        """Add what `of_results` returned for a group of recordings."""
        for note, recordings in (kept.get("notes") or {}).items():
            self.stated.setdefault(note, []).extend(recordings)
        _add_counts(self.code, kept.get("code") or {})
        _add_counts(self.packages, kept.get("packages") or {})

    def compare(self, stored: Mapping[str, Any], made: Mapping[str, Any], name: str) -> None:
        """Add what differs between two records of one result; ``name`` is that of the stage or of the recording."""
        differs = execution.differences(stored["result"], made["result"], name)
        self.differs += differs
        unlike = provenance.unlike(stored["provenance"], made["provenance"]) if differs else []
        self.unlike += [one for one in unlike if one not in self.unlike]

    def of_results(self) -> dict[str, Any]:
        """Return what `add_record` added, as the record of a whole run keeps it."""
        return {"code": self.code, "packages": self.packages, "notes": self.stated}

    def restore(self, kept: Mapping[str, Any]) -> None:
        """Take over what `of_results` returned; nothing of an older record, which has none."""
        self.code, self.packages = kept.get("code") or {}, kept.get("packages") or {}
        self.stated = kept.get("notes") or {}

    def describe_differences(self) -> str:
        """Return what differs from what is stored, and whether another computer's rounding may be why."""
        why = f" (computed with other {'; '.join(self.unlike)}, which rounds differently)" if self.unlike else ""
        return f"these differ from what is stored: {'; '.join(self.differs)}{why}"

    def describe_results(self) -> list[str]:
        """Return the notes of stages, and how many results were computed by other code than their stage has now."""
        count = self.ran + self.reused
        found = []
        for text, names in self.stated.items():
            some = f"{len(names)} recordings ({listed(sorted(names), _NAMED)})"
            some = f"all {count} recordings" if len(names) == count else some
            found.append(f"{some}: {text}" if len(names) > 1 else f"{names[0]}: {text}" if names[0] else text)
        stages = {name: line for name, counts in self.code.items() if (line := _other_code(name, counts))}
        packages = {name: line for name, counts in self.packages.items() if (line := _other_package(name, counts))}
        described = {package for name in stages if (package := registry.package_of_stage(name)) is not None}
        return [*found, *stages.values(), *(line for name, line in packages.items() if name not in described)]

    def to_json(self) -> dict[str, Any]:
        """Return the outcome as a command prints it."""
        value = {name: value for name, value in vars(self).items() if name not in _FROM_RECORDS}
        return {**value, "output": str(self.output)}


def _add_counts(total: dict[str, dict[str, int]], counts: Mapping[str, Mapping[str, int]]) -> None:
    """Add to ``total`` how many results were computed by each code, by stage or package."""
    for name, numbers in counts.items():
        added = total.setdefault(name, {})
        for code, number in numbers.items():
            added[code] = added.get(code, 0) + number


def _other_package(package: str, counts: Mapping[str, int]) -> str:
    """Return the warning for a plug-in package as `_other_code` does for a stage."""
    now = registry.package_code(package)  # None: it is gone, and its results stay valid
    outdated = sum(number for code, number in counts.items() if code != now)
    if now is None or not outdated:
        return ""
    return (
        f"{outdated} of these results were computed by other code of the package {package} than is installed now. Raise the "
        f"version of the package or of the stage if they differ, or compute them again with --rerun."
    )


def _other_code(name: str, counts: Mapping[str, int]) -> str:
    """Return the warning for a stage of which ``counts`` results were computed by each code; empty without a need."""
    try:
        stage = execution.stage_of(name)
    except TacpipeError:  # of a plug-in that is gone: its results stay valid
        return ""
    now = provenance.code(stage)
    others = sum(number for code, number in counts.items() if code != now)
    if now is None or not others:
        return ""
    return (
        f"{others} of these results were computed by other code of {name} than there is now in "
        f"{stage.function.__module__}, under the same version {stage.version}. Raise its version if they differ, "
        f"or compute them again with --rerun."
    )
