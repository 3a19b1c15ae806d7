"""The network that an architecture of the task ``forward`` builds, validated: built in or of another package."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from tacpipe.codecs import codec as codecs
from tacpipe.codecs.frame_stacking import INCREMENTS
from tacpipe.errors import TacpipeError
from tacpipe.models import forecasts
from tacpipe.models.change import PlainForecast
from tacpipe.models.ensemble import Ensemble
from tacpipe.models.windows import Shape, Windows
from tacpipe.tasks.forward.params import Forward

METHODS = ("calibrate", "loss")  # of a network that scales itself
TRIED = 2  # windows


def shape(params: Forward, codec: codecs.Codec) -> Shape:
    """Return what a network for the codec's features reads and predicts."""
    where = codec.layout if codec.kind == "raw" else ()
    changes = codec.representation == INCREMENTS
    return Shape(len(codec.latents), params.context, params.horizon, tuple(where), changes)


def build(params: Forward, codec: codecs.Codec) -> nn.Module:
    """Return the network that ``params`` build, of random weights, for the codec's features; several as an `Ensemble`.

    Raises `TacpipeError` where they build something else.
    """
    members = [_member(params, codec) for _ in range(params.members)]
    return members[0] if len(members) == 1 else Ensemble(members)


def _member(params: Forward, codec: codecs.Codec) -> nn.Module:
    """Return one network that scales itself; a plain one is put between scales."""
    given = shape(params, codec)
    made = params.build(given)
    if not isinstance(made, nn.Module):
        raise TacpipeError(
            f"The architecture {params.architecture} built {type(made).__name__}; it must build a torch.nn.Module."
        )
    own = [name for name in METHODS if hasattr(made, name)]
    if not own:
        return PlainForecast(made, given, loss=forecasts.resolved_loss("auto", changes=given.increments))
    lacking = [name for name in (*METHODS, "change_only") if not hasattr(made, name)]
    if lacking:
        raise TacpipeError(
            f"The network of the architecture {params.architecture} has {own[0]} and no {lacking[0]}: one that scales "
            f"itself needs {', '.join(METHODS)} and change_only, a plain network none of them but change_only."
        )
    return made


@torch.no_grad()
def check(network: nn.Module, params: Forward, windows: Windows, features: int) -> None:
    """Raise `TacpipeError` where a network returns something else than features to come for a few ``windows``."""
    some = Windows(*(part[:, :TRIED] for part in windows))
    training = network.training
    found = network.eval()(some)
    network.train(training)
    wanted = (params.horizon, some.touch.shape[1], features)
    if not isinstance(found, Tensor) or tuple(found.shape) != wanted:
        returned = str(tuple(found.shape)) if isinstance(found, Tensor) else type(found).__name__
        raise TacpipeError(
            f"The network of the architecture {params.architecture} returns {returned} for {wanted[1]} windows; it must "
            f"return (horizon, window, feature), here {wanted}."
        )
