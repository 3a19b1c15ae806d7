"""Build and check the networks of architectures for slides."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

from tacpipe.models.recurrent_autoencoder import AutoencoderShape, PlainClassifier
from tacpipe.models.tensors import require_network, require_output
from tacpipe.tasks.material.losses import Network
from tacpipe.tasks.material.params import NetworkParams

TRIAL_SLIDES = 2  # number of slides for a trial


def build_network(params: NetworkParams, shape: AutoencoderShape) -> Network:
    """Return the network of ``params`` for a sensor, with random weights.

    A plain network is wrapped in the common interface.

    Raises `TacpipeError` if the params build anything else.
    """
    network = require_network(params.build(shape), params.architecture)
    return cast(Network, network if hasattr(network, "classify") else PlainClassifier(network))


@torch.no_grad()
def check_network(network: nn.Module, params: NetworkParams, slides: Tensor, classes: int) -> None:
    """Raise `TacpipeError` if a network does not return scores for ``slides`` (slide, time, channel)."""
    training = network.training
    output = network.eval()(slides[:TRIAL_SLIDES].transpose(0, 1).contiguous(), decode=False)
    network.train(training)
    scores, shape = getattr(output, "scores", None), (len(slides[:TRIAL_SLIDES]), classes)
    require_output(scores, shape, params.architecture, f"{shape[0]} slides", "scores (slide, class)")
