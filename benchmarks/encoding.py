"""What it costs to encode the rows of one window with an autoencoder, as a controller does at each step."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import timing
import torch

from tacpipe.codecs.autoencoder import Autoencoder

WIDTHS = (288, 192, 96, 8)  # of three rows of 96 channels down to 8 latents
ROWS, CALLS = 10, 200


def measure(folder: Path, rounds: int) -> list[timing.Line]:
    """Return what encoding takes beside the same layers in torch."""
    rng = np.random.default_rng(0)
    encoder = tuple(
        (rng.normal(size=(after, before)).astype(np.float32) / 20, np.zeros(after, dtype=np.float32))
        for before, after in itertools.pairwise(WIDTHS)
    )
    channels = tuple(f"c{index}" for index in range(96))
    codec = Autoencoder(channels, (), np.zeros(96), np.ones(96), encoder, (), frames=3)
    window, begins = rng.normal(size=(ROWS, 96)), np.arange(ROWS) == 0
    layers = [
        layer
        for before, after in itertools.pairwise(WIDTHS)
        for layer in (torch.nn.Linear(before, after), torch.nn.ReLU())
    ]
    network, stacked = torch.nn.Sequential(*layers), torch.zeros(ROWS, WIDTHS[0])

    def ours() -> None:
        for _ in range(CALLS):
            codec.encode(window, channels, begins)

    def beside() -> None:
        with torch.no_grad():
            for _ in range(CALLS):
                network(stacked)

    times = timing.interleaved({"encode": ours, "the layers alone in torch": beside}, rounds)
    return [
        timing.at_most(
            f"{CALLS} times {ROWS} rows encoded to latents", times, "encode", "the layers alone in torch", 3.0
        )
    ]
