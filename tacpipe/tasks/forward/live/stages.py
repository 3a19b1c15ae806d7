"""Find the preprocessing stages of a model, and check that each has a causal rule."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from tacpipe.channels.streams import GRID, max_step
from tacpipe.errors import TacpipeError
from tacpipe.live.stages import CHANNELS, SYNCHRONIZE, stage_params

if TYPE_CHECKING:
    from tacpipe.store.records import Step

CONTACTS, COMPRESS = "segment.contacts", "compress."


class CausalStages(NamedTuple):
    """The params of a model's preprocessing stages; its codec is among its files."""

    synchronize: Any
    contacts: Any

    @property
    def largest_step(self) -> float:
        """The maximum distance of adjacent rows in periods; a larger one is a gap."""
        return max_step({GRID: self.synchronize.timeline})


def causal_stages(steps: Sequence[Step]) -> CausalStages:
    """Return the params of the stages of a chain, given as in manifests.

    Raises `UsageError` if the version of a stage has changed, `TacpipeError` if one has no causal rule or is missing.
    """
    params_by_stage = {}
    for step in steps:
        name = step["stage"]
        if name not in (SYNCHRONIZE, CONTACTS, *CHANNELS) and not name.startswith(COMPRESS):
            raise TacpipeError(
                f"The model was trained on the output of `tacpipe {name.replace('.', ' ')}`, which cannot run live. Train "
                f"one after synchronize, segment contacts and, optionally, extract markers or difference, and compress."
            )
        params_by_stage[name] = stage_params(step)
    missing = [name for name in (SYNCHRONIZE, CONTACTS) if name not in params_by_stage]
    if missing:
        raise TacpipeError(
            f"The model was not trained on the output of `tacpipe {missing[0].replace('.', ' ')}`, so the session "
            f"cannot compute its rows from samples. Train it on recordings that went through that stage."
        )
    if params_by_stage[CONTACTS].rest != "start":
        raise TacpipeError(
            f"The model was trained with `segment contacts --rest {params_by_stage[CONTACTS].rest}`, which searches the "
            f"complete recording for the rest level. A session takes it from the start. Train it with --rest start."
        )
    return CausalStages(params_by_stage[SYNCHRONIZE], params_by_stage[CONTACTS])
