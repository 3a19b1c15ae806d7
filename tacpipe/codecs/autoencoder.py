"""Apply a trained autoencoder of standardised tactile channels with numpy, without torch.

Every layer is weight @ x + bias, followed by an ELU (Clevert 2016: x above 0, exp(x) - 1 below) except in the last
layers of encoder and decoder. It reads one or several successive frames, newest last, and decodes the newest. numpy
suffices, so applying a codec does not import torch.
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
from tacpipe.datasets import model_files

if TYPE_CHECKING:
    Layers = tuple[tuple[AnyFloats, AnyFloats], ...]  # weight (out, in) and bias (out,) of each layer

CHUNK = 16384  # rows per chunk, which bounds the memory of hidden layers


@dataclass(frozen=True)
class Autoencoder:
    """A fitted autoencoder. Mean and scale are float64 in counts; layers are float32 without unit."""

    channels: tuple[str, ...]
    layout: tuple[Mapping[str, str], ...]
    mean_count: AnyFloats  # (channel,)
    scale_count: AnyFloats  # (channel,)
    encoder: Layers
    decoder: Layers
    frames: int = 1  # number of successive rows that the encoder reads
    representation: str = codec.LEVELS
    measured: measures.CodecMeasures = field(default_factory=measures.CodecMeasures)
    kind: str = "autoencoder"

    @property
    def latents(self) -> tuple[str, ...]:
        """The names of the latents; their order has no meaning."""
        return codec.latent_names(len(self.encoder[-1][1]))

    def encode(self, values: AnyFloats, channels: Sequence[str], begins: Bools | None = None) -> AnyFloats:
        """Return the latents (time, latent), float32, of counts above rest (time, channel).

        Raises `TacpipeError` unless ``channels`` are those of the fit, in the same order.
        """
        codec.check_channels(self.channels, channels)
        inputs = codec.codec_inputs(values, begins, self.representation, self.frames)
        return codec.encode_finite(self.project, inputs, len(self.latents))

    def project(self, inputs: AnyFloats) -> AnyFloats:
        """Return the latents (row, latent), float32, of finite rows (row, frames * channel), newest frame last."""
        return _apply_layers(self.encoder, standardise(inputs, self.mean_count, self.scale_count))

    def decode(self, latents: AnyFloats) -> AnyFloats:
        """Return the newest frame's counts (…, channel), float64, decoded from latents (…, latent)."""
        *hidden_layers, (weight, bias) = self.decoder
        newest = (*hidden_layers, (weight[-len(self.channels) :], bias[-len(self.channels) :]))
        decoded = _apply_layers(newest, latents.reshape(-1, latents.shape[-1]).astype(np.float32))
        counts: AnyFloats = decoded * self.scale_count + self.mean_count
        return counts.reshape(*latents.shape[:-1], len(self.channels))

    def to_files(self) -> dict[str, bytes]:
        """Return the content of ``codec.safetensors`` and ``codec.json``."""
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
        return {codec.TENSORS: save_tensors(tensors), codec.DESCRIPTION: codec.description(content)}

    @classmethod
    def from_files(cls, files: Mapping[str, bytes]) -> Autoencoder:
        """Return the codec that `to_files` stored."""
        content, tensors = json.loads(files[codec.DESCRIPTION]), model_files.arrays(files[codec.TENSORS], codec.TENSORS)

        def layers(part: str) -> Layers:
            indices = range(content["layers"][part])
            return tuple((tensors[f"{part}.{i}.weight"], tensors[f"{part}.{i}.bias"]) for i in indices)

        return cls(
            tuple(content["channels"]),
            tuple(content["layout"]),
            tensors["mean_count"],
            tensors["scale_count"],
            layers("encoder"),
            layers("decoder"),
            content["frames"],
            content["of"],
            measures.measures_from(content),
        )


def standardise(inputs: AnyFloats, mean_count: AnyFloats, scale_count: AnyFloats) -> AnyFloats:
    """Return rows (row, frames * channel) standardised by the mean and scale of each channel; float32."""
    frames = inputs.shape[1] // len(mean_count)
    scaled: AnyFloats = (inputs - np.tile(mean_count, frames)) / np.tile(scale_count, frames)
    return scaled.astype(np.float32)


def _apply_layers(layers: Layers, rows: AnyFloats) -> AnyFloats:
    """Return ``rows`` (row, in) after ``layers``, with an ELU between them (row, out); float32."""
    outputs = np.empty((len(rows), len(layers[-1][1])), dtype=np.float32)
    for first in range(0, len(rows), CHUNK):
        hidden = rows[first : first + CHUNK]
        for weight, bias in layers[:-1]:
            hidden = hidden @ weight.T + bias
            hidden = np.where(hidden > 0, hidden, np.expm1(np.minimum(hidden, 0)))
        weight, bias = layers[-1]
        outputs[first : first + CHUNK] = hidden @ weight.T + bias
    return outputs
