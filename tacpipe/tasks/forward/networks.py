"""The network that an architecture of the task ``forward`` builds, validated: built in or of another package."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from tacpipe.codecs import codec as codecs
from tacpipe.codecs.codec import INCREMENTS
from tacpipe.errors import TacpipeError
from tacpipe.models import forecasts
from tacpipe.models.change import PlainForecast
from tacpipe.models.forecasts import Ensemble
from tacpipe.models.windows import Shape, Windows
from tacpipe.tasks.forward.params import Forward

METHODS = ("calibrate", "loss")  # methods of a network that scales itself
TRIED = 2  # windows


def shape(params: Forward, codec: codecs.Codec) -> Shape:
    """Return what a network for the codec's features reads and predicts."""
    places = codec.layout if codec.kind == "raw" else ()
    changes = codec.representation == INCREMENTS
    return Shape(len(codec.latents), params.context, params.horizon, tuple(places), changes)


def build(params: Forward, codec: codecs.Codec) -> nn.Module:
    """Return the network that ``params`` build, of random weights, for the codec's features; several as an `Ensemble`.

    Raises `TacpipeError` where they build something else.
    """
    members = [_member(params, codec) for _ in range(params.members)]
    return members[0] if len(members) == 1 else Ensemble(members)


def _member(params: Forward, codec: codecs.Codec) -> nn.Module:
    """Return one network that scales itself; a plain one is put between scales."""
    sizes = shape(params, codec)
    network = params.build(sizes)
    if not isinstance(network, nn.Module):
        raise TacpipeError(
            f"The architecture {params.architecture} built {type(network).__name__}; it must build a torch.nn.Module."
        )
    scaling_methods = [name for name in METHODS if hasattr(network, name)]
    if not scaling_methods:
        return PlainForecast(network, sizes, loss=forecasts.resolved_loss("auto", changes=sizes.increments))
    lacking = [name for name in (*METHODS, "change_only") if not hasattr(network, name)]
    if lacking:
        raise TacpipeError(
            f"The network of the architecture {params.architecture} has {scaling_methods[0]} and no "
            f"{lacking[0]}: one that scales "
            f"itself needs {', '.join(METHODS)} and change_only, a plain network none of them but change_only."
        )
    return network


@torch.no_grad()
def check(network: nn.Module, params: Forward, windows: Windows, features: int) -> None:
    """Raise `TacpipeError` where a network returns something else than features to come for a few ``windows``."""
    sample = Windows(*(part[:, :TRIED] for part in windows))
    training = network.training
    features_ahead = network.eval()(sample)
    network.train(training)
    expected = (params.horizon, sample.touch.shape[1], features)
    if not isinstance(features_ahead, Tensor) or tuple(features_ahead.shape) != expected:
        returned = (
            str(tuple(features_ahead.shape)) if isinstance(features_ahead, Tensor) else type(features_ahead).__name__
        )
        raise TacpipeError(
            f"The network of the architecture {params.architecture} returns {returned} for {expected[1]} windows; it must "
            f"return (horizon, window, feature), here {expected}."
        )
