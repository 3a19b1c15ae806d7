"""Assign roles to recordings: train, val, calibration, test.

Example: tacpipe split data/segments -o data/split --calibration 0.15
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from tacpipe.errors import UsageError
from tacpipe.plugins.constraints import Names, NonNegativeInt, PositiveInt, Range, Seed
from tacpipe.plugins.params import added
from tacpipe.plugins.stage import Attribute, RecordingOutput, Result, Roles, stage
from tacpipe.printable import listed

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset
    from tacpipe.datasets.splits import Scheme

SHOWN = 5  # maximum number of folds listed in a note; further ones are counted


@dataclass(frozen=True)
class Split:
    """Params of all schemes."""

    scheme: str
    # fraction of the recordings for validation; of the remaining ones if the scheme selects the test recordings
    val: Annotated[float, Range(0, below=1)] = 0.15
    # fraction, as for val, that only `tacpipe calibrate` uses; the task forward requires it for calibration
    calibration: Annotated[float, Range(0, below=1)] = added(0.0)
    seed: Seed = 0  # random seed of every draw
    stratify: Names = ""  # attributes whose values are spread evenly over the roles; empty: none
    few: NonNegativeInt = 0  # maximum number of training recordings; others are unused; 0: all
    few_by: str = ""  # attribute, such as sensor, to each of whose values few applies separately; empty: to all
    few_of: str = ""  # attribute=value of the recordings that few limits, such as sensor=roboskin; empty: all

    def check(self) -> None:
        """Raise `UsageError` for options that need few, and for an attribute without a value."""
        if not self.few and (self.few_by or self.few_of):
            option = "few_by" if self.few_by else "few_of"
            raise UsageError(
                f"{option} is {self.few_by or self.few_of} and few is 0; it must be 1 or more with {option}."
            )
        if self.few_of and not all(self.few_of.partition("=")):
            raise UsageError(f"few_of is {self.few_of!r}; it must be an attribute and a value, as sensor=roboskin.")

    @property
    def assigned(self) -> Scheme:
        """The scheme that assigns roles."""
        from tacpipe.datasets.splits import Scheme

        values = asdict(self)
        return Scheme(name=values.pop("scheme"), **values)

    def separated(
        self, attributes: Mapping[str, Mapping[str, Attribute]], extend: Roles, equal: Sequence[Sequence[str]]
    ) -> list[Sequence[str]]:
        """Return the groups of ``equal`` recordings that the scheme would give different roles; they enter the key."""
        from tacpipe.datasets import splits

        return splits.separated(splits.assign(attributes, self.assigned, extend), equal)


@dataclass(frozen=True)
class Tested(Split):
    """Params of schemes with a fraction of test recordings."""

    test: Annotated[float, Range(0, below=1)] = 0.15  # fraction of the recordings for testing

    def check(self) -> None:
        """Raise `UsageError` for fractions that leave no training recordings."""
        super().check()
        if self.val + self.calibration + self.test >= 1:
            raise UsageError(
                f"val is {self.val:g}, calibration is {self.calibration:g} and test is {self.test:g}, which leave no "
                "recordings to train on; their sum must be below 1."
            )


@dataclass(frozen=True)
class Random(Tested):
    """Roles drawn at random."""

    # random: roles drawn at random
    scheme: Literal["random"] = "random"
    repeats: PositiveInt = 1  # number of folds, each drawn separately
    group: Names = added("")  # attributes whose values stay whole, such as object,session; empty: none


@dataclass(frozen=True)
class Kfold(Split):
    """Each recording is a test recording in one of several folds."""

    # kfold: each recording is tested in one of several folds
    scheme: Literal["kfold"] = "kfold"
    folds: Annotated[int, Range(2)] = 5  # number of parts
    apart: str = ""  # attribute whose values are also distributed, each absent from training in one fold; empty: none
    group: Names = added("")  # attributes whose values stay whole, such as object,session; empty: none

    def check(self) -> None:
        """Raise `UsageError` for group with apart, which tests some recordings of a group and trains on others."""
        super().check()
        if self.group and self.apart:
            raise UsageError(
                f"group is {self.group} and apart is {self.apart}; apart divides groups. Give one of them, or the scheme "
                f"leave-one-out by {self.apart}."
            )


@dataclass(frozen=True)
class Blocked(Tested):
    """Recordings in the order of names, which is usually that of time: train, then calibration, val and test."""

    # blocked: in the order of names
    scheme: Literal["blocked"] = "blocked"
    reverse: bool = False  # test the first recordings in the order of names and train on the last


@dataclass(frozen=True)
class LeaveOneOut(Split):
    """The recordings with one value of an attribute are tested in each fold."""

    # leave-one-out: all recordings of a value
    scheme: Literal["leave-one-out"] = "leave-one-out"
    by: str = "object"  # attribute whose values are tested one at a time


@dataclass(frozen=True)
class Authors(Split):
    """The roles assigned by the authors of a published dataset."""

    # authors: roles assigned by the authors of a published dataset
    scheme: Literal["authors"] = "authors"


Params = Random | Kfold | Blocked | LeaveOneOut | Authors


@stage(version=1)
def split(params: Params, recordings: Dataset, extend: Roles | None = None) -> Result:
    """Assign each recording a role: train, val, calibration or test.

    Returns one table, ``split``, with one row per recording and fold: recording, fold, role. Recordings with a role in
    the older split ``extend`` keep it. Recordings with equal content have the same role. Notes name these, and folds
    without validation recordings, unless ``val`` is 0.
    """
    import pyarrow as pa

    from tacpipe.datasets.selection import RecordingAttributes, equal_recordings
    from tacpipe.datasets.splits import assign, separated, sufficient_val, without_val

    attributes = RecordingAttributes(recordings)
    equal = equal_recordings(attributes.entries)
    joined = equal if params.separated(attributes, extend or {}, equal) else []
    roles = assign(attributes, params.assigned, extend or {}, joined)
    bare = without_val(roles) if params.val else []
    enough = sufficient_val(attributes, params.assigned, extend or {}, joined) if bare else None
    table = pa.table(
        {
            "recording": pa.array([name for name, _ in roles], pa.string()),
            "fold": pa.array([fold for _, fold in roles], pa.int32()),
            "role": pa.array(list(roles.values()), pa.string()),
        }
    )
    notes = [_note_on_val(bare, len({fold for _, fold in roles}), len(attributes), params.val, enough)] if bare else []
    notes += [_note_on_equal(equal, separated(roles, equal))] if equal else []
    return Result(recordings={"split": RecordingOutput(table)}, notes=notes)


def _note_on_equal(groups: Sequence[Sequence[str]], separate: Sequence[Sequence[str]]) -> str:
    """Return a note on groups of recordings with equal content, some of which an older split keeps ``separate``."""
    copies = sum(map(len, groups)) - len(groups)
    examples = listed([" = ".join(group) for group in separate or groups], SHOWN)
    roles = f"keep different roles of the split to extend: {examples}" if separate else f"have its role: {examples}"
    subject = "1 recording has" if copies == 1 else f"{copies} recordings have"
    return f"{subject} the content of another one, and {roles}. `tacpipe label --exclude` removes copies."


def _note_on_val(
    folds_without_val: Sequence[int], fold_count: int, recording_count: int, val: float, sufficient_val: float | None
) -> str:
    """Return a note on folds without validation recordings; ``sufficient_val``: fraction that suffices, if known."""
    fold_numbers = ", ".join(map(str, folds_without_val[:SHOWN])) + (
        f" and {len(folds_without_val) - SHOWN} more" if len(folds_without_val) > SHOWN else ""
    )
    subject = (
        f"Folds {fold_numbers} of {fold_count} have"
        if len(folds_without_val) > 1
        else f"Fold {fold_numbers} of {fold_count} has"
    )
    advice = f"Give --val {sufficient_val:g}" if sufficient_val else "Add recordings"
    return (
        f"{subject} no validation recording: val {val:g} of {recording_count} recordings gives none. {advice}, or --val 0 "
        f"if none is needed; networks are stopped or chosen by validation recordings."
    )
