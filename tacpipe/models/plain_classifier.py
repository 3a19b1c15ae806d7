"""A network that returns scores of slides and nothing else, as the ones with latents are called."""

from __future__ import annotations

from torch import Tensor, nn

from tacpipe.models.recurrent_autoencoder import NetworkOutput


class PlainClassifier(nn.Module):
    """Its scores are its latents too: there is nothing before them that another sensor's classifier could read."""

    def __init__(self, network: nn.Module) -> None:
        """Take a network from slides (time, slide, channel) to scores (slide, class)."""
        super().__init__()
        self.network = network

    def forward(self, frames: Tensor, *, decode: bool = True) -> NetworkOutput:
        """Return the output for slides ``frames`` (time, slide, channel), which has no frames."""
        scores: Tensor = self.network(frames)
        return NetworkOutput(scores, scores, None)

    def classify(self, latents: Tensor) -> Tensor:
        """Return ``latents`` (slide, class), which are scores."""
        return latents
