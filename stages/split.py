"""Give each recording its role: train, val or test."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.stage import Recording, Result, stage

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tacpipe.dataset import Dataset
    from tacpipe.stage import Roles

SHOWN = 5  # folds that a note lists before it counts the rest


@dataclass(frozen=True)
class Params:
    """How recordings are dealt out."""

    scheme: str = "random"  # random, kfold, blocked (in the order of names), leave-one-out or authors
    val: float = 0.15  # share of the recordings to watch; where the scheme picks the test ones, of the others
    test: float = 0.15  # share of the recordings to test; of no effect with kfold, leave-one-out and authors
    seed: int = 0  # of every draw
    folds: int = 5  # how many parts kfold makes
    by: str = "object"  # attribute whose values leave-one-out leaves out one by one
    stratify: str = ""  # attributes, commas between, whose values are spread evenly over the roles; empty for none
    apart: str = ""  # of kfold: attribute whose values are dealt out too, each unknown in one fold; empty for none
    repeats: int = 1  # of random: folds, each another draw
    reverse: bool = False  # of blocked: test the first in the order of names and train on the last
    few: int = 0  # at most so many recordings train, and those left over are unused; 0 for all
    few_by: str = ""  # attribute of whose every value that many train, as sensor; empty for that many altogether
    few_of: str = ""  # attribute=value of the recordings that few is about, as sensor=roboskin; empty for all


@stage(version=1)
def split(params: Params, recordings: Dataset, extend: Roles | None = None) -> Result:
    """Return one table, ``split``, with a row a recording and fold: recording, fold, role.

    Recordings that have a role in the older split ``extend`` keep it. A note names folds without validation recordings,
    unless ``val`` is 0.
    """
    import pyarrow as pa

    from tacpipe.splits import Scheme, assign, sufficient_val, without_val

    scheme = Scheme(
        name=params.scheme,
        val=params.val,
        test=params.test,
        seed=params.seed,
        folds=params.folds,
        by=params.by,
        stratify=params.stratify,
        apart=params.apart,
        repeats=params.repeats,
        reverse=params.reverse,
        few=params.few,
        few_by=params.few_by,
        few_of=params.few_of,
    )
    attributes = {name: shard.attributes for name, shard in recordings.shards.items()}
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
    return Result(recordings={"split": Recording(table)}, notes=notes)


def _note(bare: Sequence[int], folds: int, recordings: int, val: float, enough: float | None) -> str:
    """Return the sentence on folds without validation recordings; ``enough`` is a share that would leave none so."""
    named = ", ".join(map(str, bare[:SHOWN])) + (f" and {len(bare) - SHOWN} more" if len(bare) > SHOWN else "")
    subject = f"Folds {named} of {folds} have" if len(bare) > 1 else f"Fold {named} of {folds} has"
    advice = f"Give --val {enough:g}" if enough else "Add recordings"
    return (
        f"{subject} no validation recording: val {val:g} of {recordings} recordings gives none. {advice}, or --val 0 if "
        f"none is needed; networks are stopped or chosen by validation recordings."
    )
