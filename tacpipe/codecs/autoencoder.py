"""An autoencoder of standardised tactile channels, as it is once it is trained: layers of numbers, without torch.

Every layer is weight @ x + bias, an ELU (Clevert 2016: x above 0, exp(x) - 1 below) behind all but the last of encoder
and decoder. It reads one frame or some in a row, newest last, and gives the newest back. numpy suffices for it, so that
whoever applies a codec starts without torch.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from safetensors.numpy import save as save_tensors

from tacpipe.arrays import AnyFloats, Bools
from tacpipe.codecs import codec, measures
from tacpipe.codecs.codec import (
    DESCRIPTION,
    TENSORS,
    check_channels,
    description,
    encode_finite,
    latent_names,
)
from tacpipe.datasets import model_files

if TYPE_CHECKING:
    Layers = tuple[tuple[AnyFloats, AnyFloats], ...]  # weight (out, in) and bias (out,) of each

CHUNK = 16384  # rows worked on at once, so that the widths of hidden layers do not count in memory


@dataclass(frozen=True)
class Autoencoder:
    """A fitted codec. Mean and scale are float64 in counts, layers float32 without unit."""

    channels: tuple[str, ...]
    layout: tuple[Mapping[str, str], ...]
    mean_count: AnyFloats  # (channel,)
    scale_count: AnyFloats  # (channel,)
    encoder: Layers
    decoder: Layers
    frames: int = 1  # rows in a row that it reads
    representation: str = codec.LEVELS
    measured: measures.CodecMeasures = field(default_factory=measures.CodecMeasures)
    kind: str = "autoencoder"

    @property
    def latents(self) -> tuple[str, ...]:
        """The names of the latents, which are in no order."""
        return latent_names(len(self.encoder[-1][1]))

    def encode(self, values: AnyFloats, channels: Sequence[str], begins: Bools | None = None) -> AnyFloats:
        """Return the latents of counts above rest as float32, (time, channel) to (time, latent).

        Raises `TacpipeError` unless ``channels`` are those of the fit, in their order.
        """
        check_channels(self.channels, channels)
        inputs = codec.inputs(values, begins, self.representation, self.frames)
        return encode_finite(self.project, inputs, len(self.latents))

    def project(self, inputs: AnyFloats) -> AnyFloats:
        """Return the latents (row, latent), float32, of finite rows (row, frames * channel), newest frame last."""
        return _through(self.encoder, scaled(inputs, self.mean_count, self.scale_count))

    def decode(self, latents: AnyFloats) -> AnyFloats:
        """Return the newest frame's counts that latents decode to as float64, (…, latent) to (…, channel)."""
        *first, (weight, bias) = self.decoder
        newest = (*first, (weight[-len(self.channels) :], bias[-len(self.channels) :]))
        decoded = _through(newest, latents.reshape(-1, latents.shape[-1]).astype(np.float32))
        counts: AnyFloats = decoded * self.scale_count + self.mean_count
        return counts.reshape(*latents.shape[:-1], len(self.channels))

    def to_files(self) -> dict[str, bytes]:
        """Return the codec as the content of ``codec.safetensors`` and ``codec.json``."""
        content = {
            **self.measured,
            "kind": self.kind,
            "of": self.representation,
            "frames": self.frames,
            "channels": list(self.channels),
            "layout": [dict(channel) for channel in self.layout],
            "latents": len(self.latents),
            "layers": {"encoder": len(self.encoder), "decoder": len(self.decoder)},
        }
        tensors = {"mean_count": self.mean_count, "scale_count": self.scale_count}
        for part, layers in (("encoder", self.encoder), ("decoder", self.decoder)):
            for index, (weight, bias) in enumerate(layers):
                tensors[f"{part}.{index}.weight"] = np.ascontiguousarray(weight)
                tensors[f"{part}.{index}.bias"] = np.ascontiguousarray(bias)
        return {TENSORS: save_tensors(tensors), DESCRIPTION: description(content)}

    @classmethod
    def from_files(cls, files: Mapping[str, bytes]) -> Autoencoder:
        """Return the codec that `to_files` wrote."""
        content, tensors = json.loads(files[DESCRIPTION]), model_files.arrays(files[TENSORS], TENSORS)
        encoder, decoder = (
            tuple((tensors[f"{part}.{i}.weight"], tensors[f"{part}.{i}.bias"]) for i in range(content["layers"][part]))
            for part in ("encoder", "decoder")
        )
        return cls(
            tuple(content["channels"]),
            tuple(content["layout"]),
            tensors["mean_count"],
            tensors["scale_count"],
            encoder,
            decoder,
            content["frames"],
            content["of"],
            measures.stored(content),
        )


def scaled(inputs: AnyFloats, mean_count: AnyFloats, scale_count: AnyFloats) -> AnyFloats:
    """Return rows (row, frames * channel) as float32 with every frame's channels in units of their scale."""
    frames = inputs.shape[1] // len(mean_count)
    inputs_scaled: AnyFloats = ((inputs - np.tile(mean_count, frames)) / np.tile(scale_count, frames)).astype(
        np.float32
    )
    return inputs_scaled


def _through(layers: Layers, rows: AnyFloats) -> AnyFloats:
    """Return what ``layers`` make of ``rows`` (row, in), shape (row, out)."""
    outputs = np.empty((len(rows), len(layers[-1][1])), dtype=np.float32)
    for first in range(0, len(rows), CHUNK):
        hidden = rows[first : first + CHUNK]
        for weight, bias in layers[:-1]:
            hidden = hidden @ weight.T + bias
            hidden = np.where(hidden > 0, hidden, np.expm1(np.minimum(hidden, 0)))
        weight, bias = layers[-1]
        outputs[first : first + CHUNK] = hidden @ weight.T + bias
    return outputs
