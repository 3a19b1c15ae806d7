"""Principal components of standardised tactile channels.

The equations are those of any textbook (Pearson 1901): with the training rows' mean and standard deviation s of each
channel, latent = W ((counts - mean) / s) with orthonormal rows in W, and counts = mean + s (latent W).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from tacpipe.codecs.codec import DESCRIPTION, TENSORS, check_channels, latent_names
from tacpipe.errors import TacpipeError

if TYPE_CHECKING:
    Floats = np.ndarray[Any, np.dtype[np.floating[Any]]]


@dataclass(frozen=True)
class PCA:
    """A fitted codec. Arrays are float64: mean and scale in counts, ``components`` without unit."""

    channels: tuple[str, ...]
    layout: tuple[Mapping[str, str], ...]
    mean_count: Floats  # (channel,)
    scale_count: Floats  # (channel,)
    components: Floats  # (latent, channel)
    explained_ratio: Floats  # (latent,)
    kind: str = "pca"

    @property
    def latents(self) -> tuple[str, ...]:
        """The names of the latents: ``z00`` holds the most variance."""
        return latent_names(len(self.components))

    def encode(self, values: Floats, channels: Sequence[str]) -> Floats:
        """Return the latents of counts above rest as float32, (time, channel) to (time, latent).

        Raises `TacpipeError` unless ``channels`` are those of the fit, in their order.
        """
        check_channels(self.channels, channels)
        latents = ((values - self.mean_count) / self.scale_count) @ self.components.T  # (time, latent)
        return latents.astype(np.float32)

    def decode(self, latents: Floats) -> Floats:
        """Return the counts above rest that latents stand for as float64, (…, latent) to (…, channel)."""
        return (latents @ self.components) * self.scale_count + self.mean_count

    def to_files(self) -> dict[str, bytes]:
        """Return the codec as the content of ``codec.safetensors`` and ``codec.json``."""
        description = {
            "kind": self.kind,
            "channels": list(self.channels),
            "layout": [dict(one) for one in self.layout],
            "latents": len(self.components),
            "explained_ratio": [round(float(ratio), 9) for ratio in self.explained_ratio],
        }
        tensors = {
            "mean_count": self.mean_count,
            "scale_count": self.scale_count,
            "components": np.ascontiguousarray(self.components),
            "explained_ratio": self.explained_ratio,
        }
        return {
            TENSORS: save_tensors(tensors),
            DESCRIPTION: (json.dumps(description, indent=1, sort_keys=True) + "\n").encode(),
        }

    @classmethod
    def from_files(cls, files: Mapping[str, bytes]) -> PCA:
        """Return the codec that `to_files` wrote."""
        description, tensors = json.loads(files[DESCRIPTION]), load_tensors(files[TENSORS])
        return cls(
            tuple(description["channels"]),
            tuple(description["layout"]),
            tensors["mean_count"],
            tensors["scale_count"],
            tensors["components"],
            tensors["explained_ratio"],
        )


def fit(
    values: Floats,
    channels: Sequence[str],
    layout: Sequence[Mapping[str, str]],
    *,
    components: int = 20,
    variance: float = 0.0,
) -> PCA:
    """Return the codec fitted on counts above rest ``values``, shape (time, channel).

    It keeps ``components`` latents or, where ``variance`` is above 0, as many as hold this share of the variance.
    A channel that never moves gets the scale 1. The sign of each component is such that its largest weight is positive.
    Raises `TacpipeError` for a count or share that the data cannot give.
    """
    rows, width = values.shape
    most = min(rows - 1, width)
    if most < 1:
        raise TacpipeError(f"A codec cannot be fitted on {rows} rows. Give it training recordings with contact.")
    if not 0 <= variance < 1:
        raise TacpipeError(f"variance is {variance}; it is a share between 0 and 1. Use 0 to count components instead.")
    if variance == 0 and not 1 <= components <= most:
        raise TacpipeError(f"components is {components}; {rows} rows of {width} channels give 1 to {most}.")
    from sklearn import decomposition

    mean, scale = values.mean(axis=0), values.std(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    found = decomposition.PCA(variance or components, svd_solver="full").fit((values - mean) / scale)
    weights = np.asarray(found.components_, dtype=np.float64)  # (latent, channel)
    largest = np.take_along_axis(weights, np.abs(weights).argmax(axis=1)[:, None], axis=1)
    return PCA(
        tuple(channels),
        tuple(layout),
        mean,
        scale,
        weights * np.where(largest < 0, -1.0, 1.0),
        np.asarray(found.explained_variance_ratio_, dtype=np.float64),
    )
