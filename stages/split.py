"""Assign roles to recordings: train, val, calibration, test.

Example: tacpipe split data/segments -o data/split --calibration 0.15
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from tacpipe.errors import UsageError
from tacpipe.plugins.constraints import Names, NonNegativeInt, PositiveInt, Range, Seed
from tacpipe.plugins.params import added
from tacpipe.plugins.stage import RecordingOutput, Result, stage

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tacpipe.datasets.dataset import Dataset
    from tacpipe.plugins.stage import Roles

SHOWN = 5  # folds that a note lists before it counts the rest


@dataclass(frozen=True)
class Split:
    """Params that all schemes have."""

    scheme: str
    # fraction of the recordings to validate on; if the scheme selects the test recordings, of the others
    val: Annotated[float, Range(0, below=1)] = 0.15
    # fraction, as val, that only `tacpipe calibrate` uses; forward needs some for it
    calibration: Annotated[float, Range(0, below=1)] = added(0.0)
    seed: Seed = 0  # random seed of every draw
    stratify: Names = ""  # attributes whose values are spread evenly over the roles; empty for none
    few: NonNegativeInt = 0  # maximum number of recordings to train on; others are unused; 0 for all
    few_by: str = ""  # attribute, such as sensor; few counts the recordings of each of its values; empty: of all
    few_of: str = ""  # attribute=value of the recordings that few limits, such as sensor=roboskin; empty for all

    def check(self) -> None:
        """Refuse options that need few, and an attribute without a value."""
        if not self.few and (self.few_by or self.few_of):
            option = "few_by" if self.few_by else "few_of"
            raise UsageError(
                f"{option} is {self.few_by or self.few_of} and few is 0; it must be 1 or more with {option}."
            )
        if self.few_of and not all(self.few_of.partition("=")):
            raise UsageError(f"few_of is {self.few_of!r}; it must be an attribute and a value, as sensor=roboskin.")


@dataclass(frozen=True)
class Tested(Split):
    """Schemes that are given how many recordings to test on."""

    test: Annotated[float, Range(0, below=1)] = 0.15  # fraction of the recordings to test on

    def check(self) -> None:
        """Refuse fractions that leave nothing to train on."""
        super().check()
        if self.val + self.calibration + self.test >= 1:
            raise UsageError(
                f"val is {self.val:g}, calibration is {self.calibration:g} and test is {self.test:g}, which leave "
                f"no recordings "
                f"to train on; their sum must be below 1."
            )


@dataclass(frozen=True)
class Random(Tested):
    """Roles drawn at random."""

    # random: roles drawn at random
    scheme: Literal["random"] = "random"
    repeats: PositiveInt = 1  # folds, each another draw


@dataclass(frozen=True)
class Kfold(Split):
    """Each recording is tested in one of several folds."""

    # kfold: each recording is tested in one of several folds
    scheme: Literal["kfold"] = "kfold"
    folds: Annotated[int, Range(2)] = 5  # number of parts
    apart: str = ""  # attribute whose values are distributed too, each unknown in one fold; empty for none


@dataclass(frozen=True)
class Blocked(Tested):
    """Recordings in the order of names, which is that of time for most sets: train, then calibration, val and test."""

    # blocked: in the order of names
    scheme: Literal["blocked"] = "blocked"
    reverse: bool = False  # test the first in the order of names and train on the last


@dataclass(frozen=True)
class LeaveOneOut(Split):
    """The recordings of one value of an attribute are tested in each fold."""

    # leave-one-out: all recordings of a value
    scheme: Literal["leave-one-out"] = "leave-one-out"
    by: str = "object"  # attribute whose values are left out one by one


@dataclass(frozen=True)
class Authors(Split):
    """The roles that the authors of a published set gave."""

    # authors: as the authors of a published set did
    scheme: Literal["authors"] = "authors"


Params = Random | Kfold | Blocked | LeaveOneOut | Authors


@stage(version=1)
def split(params: Params, recordings: Dataset, extend: Roles | None = None) -> Result:
    """Give each recording its role: train, val, calibration or test.

    Returns one table, ``split``, with one row per recording and fold: recording, fold, role. Recordings that have a role in
    the older split ``extend`` keep it. A note names folds without validation recordings, unless ``val`` is 0.
    """
    import pyarrow as pa

    from tacpipe.datasets.selection import RecordingAttributes
    from tacpipe.datasets.splits import Scheme, assign, sufficient_val, without_val

    values = asdict(params)
    scheme = Scheme(name=values.pop("scheme"), **values)
    attributes = RecordingAttributes(recordings)
    roles = assign(attributes, scheme, extend or {})
    bare = without_val(roles) if params.val else []
    enough = sufficient_val(attributes, scheme, extend or {}) if bare else None
    table = pa.table(
        {
            "recording": pa.array([name for name, _ in roles], pa.string()),
            "fold": pa.array([fold for _, fold in roles], pa.int32()),
            "role": pa.array(list(roles.values()), pa.string()),
        }
    )
    notes = [_note(bare, len({fold for _, fold in roles}), len(attributes), params.val, enough)] if bare else []
    return Result(recordings={"split": RecordingOutput(table)}, notes=notes)


def _note(bare: Sequence[int], folds: int, recordings: int, val: float, enough: float | None) -> str:
    """Return the sentence on folds without validation recordings; ``enough`` is a fraction that would leave none so."""
    fold_numbers = ", ".join(map(str, bare[:SHOWN])) + (f" and {len(bare) - SHOWN} more" if len(bare) > SHOWN else "")
    subject = f"Folds {fold_numbers} of {folds} have" if len(bare) > 1 else f"Fold {fold_numbers} of {folds} has"
    advice = f"Give --val {enough:g}" if enough else "Add recordings"
    return (
        f"{subject} no validation recording: val {val:g} of {recordings} recordings gives none. {advice}, or --val 0 if "
        f"none is needed; networks are stopped or chosen by validation recordings."
    )
