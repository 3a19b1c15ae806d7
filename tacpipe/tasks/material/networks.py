"""The network that an architecture of the task ``material`` builds, validated: built in or of another package."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

from tacpipe.errors import TacpipeError
from tacpipe.models.recurrent_autoencoder import AutoencoderShape, PlainClassifier
from tacpipe.tasks.material.losses import Network
from tacpipe.tasks.material.params import MaterialModelParams
from tacpipe.tasks.material.params import NetworkParams as NetworkParams

TRIED = 2  # slides


def build(params: MaterialModelParams, shape: AutoencoderShape) -> Network:
    """Return the network that ``params`` build for a sensor, of random weights; a plain one wrapped, to be called as others.

    Raises `TacpipeError` where they build something else.
    """
    network = params.build(shape) if isinstance(params, NetworkParams) else None
    if not isinstance(network, nn.Module):
        raise TacpipeError(
            f"The architecture {params.architecture} built {type(network).__name__}; it must build a torch.nn.Module."
        )
    return cast(Network, network if hasattr(network, "classify") else PlainClassifier(network))


@torch.no_grad()
def check(network: nn.Module, params: NetworkParams, slides: Tensor, classes: int) -> None:
    """Raise `TacpipeError` where a network returns something else than scores for ``slides`` (slide, time, channel)."""
    training = network.training
    output = network.eval()(slides[:TRIED].transpose(0, 1).contiguous(), decode=False)
    network.train(training)
    scores, shape = getattr(output, "scores", None), (len(slides[:TRIED]), classes)
    if not isinstance(scores, Tensor) or tuple(scores.shape) != shape:
        returned = str(tuple(scores.shape)) if isinstance(scores, Tensor) else type(scores).__name__
        raise TacpipeError(
            f"The network of the architecture {params.architecture} returns {returned} for {shape[0]} slides; it must "
            f"return scores (slide, class), here {shape}."
        )
